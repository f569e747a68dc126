"""`a4 cache info` and `a4 cache clear`: the answers kept on disk."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from a4agent.cli import common
from a4agent.engine.cache import FORMAT, Cache, CacheInfo, default_folder
from a4agent.errors import InputError

app = typer.Typer(help="Show or clear the answers kept on disk.", no_args_is_help=True)

FolderOption = Annotated[
    Path | None, typer.Option("--folder", help="Another cache than the one of the settings (engine.cache_dir).")
]


@app.command()
def info(
    folder: FolderOption = None,
    as_json: common.JsonOption = False,
) -> None:
    """Say where the cache is and how much it holds."""
    place, limit_gb = _place(folder)
    found = Cache(place).info() if _is_cache(place) else CacheInfo(place, 0, 0)
    if as_json:
        limit = int(limit_gb * 1e9)
        common.print_json({"folder": str(place), "entries": found.entries, "bytes": found.bytes, "limit_bytes": limit})
    else:
        print(f"{place}: {_size(found)}; the limit is {limit_gb:g} GB (engine.cache_gb)")


@app.command()
def clear(
    folder: FolderOption = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
) -> None:
    """Remove all answers; the next run asks for them again."""
    place, _ = _place(folder)
    if not _is_cache(place):
        print(f"{place}: nothing to remove")
        return
    cache = Cache(place)
    if not yes and not typer.confirm(f"Remove {_size(cache.info())} in {place}?", default=False, err=True):
        raise InputError("nothing was removed; add --yes to remove without a question")
    print(f"{place}: removed {_size(cache.clear())}")


def _place(folder: Path | None) -> tuple[Path, float]:
    """The cache folder and its limit in GB."""
    engine = common.settings(None).engine
    return folder or engine.cache_dir or default_folder(), engine.cache_gb


def _is_cache(place: Path) -> bool:
    """Whether answers were ever kept in `place`, without creating it."""
    return (place / FORMAT).is_dir()


def _size(info: CacheInfo) -> str:
    size = f"{info.bytes / 1e6:.1f} MB" if info.bytes >= 1e5 else f"{info.bytes / 1e3:.1f} kB"
    return f"{info.entries} answers, {size}"
