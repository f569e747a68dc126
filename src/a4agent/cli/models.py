"""`a4 models list | pull | verify`: what a profile needs on disk, fetched and checked."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from a4agent import requirements
from a4agent.cli import common
from a4agent.cli.common import JsonOption, ProfileOption, SetOption, messages, say
from a4agent.config import ExpertSettings, profile_names
from a4agent.errors import ModelFilesError, ResourceError, UnknownNameError
from a4agent.experts import hub
from a4agent.experts.checkpoint_files import damage_in
from a4agent.requirements import Need

app = typer.Typer(no_args_is_help=True)

NamesArgument = Annotated[
    list[str] | None,
    typer.Argument(metavar="[NAME]...", help="Profiles, experts (sam2:tiny), folders or OWNER/NAME[@REVISION]."),
]


@app.command("list")
def list_models(
    names: NamesArgument = None, profile: ProfileOption = None, sets: SetOption = None, as_json: JsonOption = False
) -> None:
    """Say which models there are or a profile needs: size, licence, gating, and what is on this disk."""
    chosen = _with_profile(names, profile)
    found = _needs(chosen, sets) if chosen else [requirements.need(name) for name in requirements.catalogue()]
    if as_json:
        common.print_json([_as_dict(need) for need in found])
    else:
        _show(found, everything=not chosen)


@app.command()
def pull(
    names: NamesArgument = None,
    profile: ProfileOption = None,
    sets: SetOption = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask before the download starts.")] = False,
) -> None:
    """Fetch models. A download that broke off is continued; complete files are not fetched twice.

    Prints sizes, licences and gating first. HF_HOME moves the cache, HF_TOKEN opens gated models.
    """
    needs = _named(_with_profile(names, profile), sets)
    missing = [need for need in needs if need.path is None]
    for need in needs:
        if need.path is not None:
            say(f"{need.name} is here: {need.path}")
    if not missing:
        return
    sizes = {need: hub.download_bytes(need.name, need.revision, need.file) for need in missing}
    for need, size in sizes.items():
        place = f" ({need.file})" if need.file else ""
        say(f"{need.name}{place}: {size / 1e9:.2f} GB; {need.terms}")
    say(f"{sum(sizes.values()) / 1e9:.2f} GB to fetch")
    _check_room(sum(sizes.values()))
    if not yes and sys.stdin.isatty() and not typer.confirm("Fetch them?", default=True, err=True):
        raise typer.Exit(common.USAGE)
    for need in missing:
        path = hub.fetch(need.name, need.revision, need.file)
        say(f"fetched {need.reference}: {path}")


@app.command()
def verify(
    names: NamesArgument = None,
    profile: ProfileOption = None,
    sets: SetOption = None,
    quick: Annotated[bool, typer.Option("--quick", help="Look at sizes and headers only, not at every byte.")] = False,
) -> None:
    """Check that models on this disk are whole; no network. Exit code 1 if one is not."""
    damaged = 0
    for need in _named(_with_profile(names, profile), sets):
        if need.path is None:
            damaged += 1
            messages.print(f"[red]missing[/] {escape(f'{need.name}: a4 models pull {need.reference}')}", soft_wrap=True)
            continue
        name = escape(need.name)
        with messages.status(f"reading {name}"):
            found = damage_in(need.path, contents=not quick)
        for problem in found:
            messages.print(f"[red]damaged[/] {name}: {escape(problem)}", soft_wrap=True)
        if found:
            damaged += 1
            say(f"  {_repair(need, need.path)}")
        else:
            messages.print(f"[green]whole[/]   {name}", soft_wrap=True)
    if damaged:
        raise typer.Exit(common.SOME_FAILED)


def _repair(need: Need, path: Path) -> str:
    """How to replace damaged files. In the hub's cache, snapshots are links into the folder to delete."""
    if need.is_folder:
        return "it is your own: replace what is damaged by hand"
    stored = next((parent.parent for parent in path.parents if parent.name == "snapshots"), path)
    return f"delete {stored} and run: a4 models pull {need.reference}"


def _with_profile(names: list[str] | None, profile: str | None) -> list[str]:
    return [*(names or []), *([profile] if profile else [])]


def _named(names: list[str], sets: list[str] | None) -> list[Need]:
    if not names:
        raise ModelFilesError("name a profile, an expert or a model: a4 models pull small, a4 models pull sam2:tiny")
    return _needs(names, sets)


def _needs(names: list[str], sets: list[str] | None) -> list[Need]:
    """The checkpoints behind names, each once."""
    found = {(need.name, need.file, need.revision): need for name in names for need in _needs_of(name, sets)}
    return list(found.values())


def _needs_of(name: str, sets: list[str] | None) -> list[Need]:
    if name in profile_names() or name.endswith(".toml"):
        return requirements.needs(common.settings(name, sets).expert_specs())
    if ":" in name and "/" not in name.partition(":")[0] and "\\" not in name:
        return requirements.needs({name: ExpertSettings(expert=name)})
    try:
        return [requirements.need(name)]
    except ModelFilesError as error:
        known = [*profile_names(), *requirements.catalogue()]
        raise UnknownNameError.of("profile or model", name, known) from error


def _as_dict(need: Need) -> dict[str, Any]:
    return {
        "name": need.name,
        "file": need.file or None,
        "roles": list(need.roles),
        "gigabytes": need.info.gigabytes,
        "licence": need.info.licence,
        "gated": need.info.gated,
        "commercial": need.info.commercial,
        "code": need.info.code,
        "revision": need.revision,
        "path": str(need.path) if need.path else None,
        "commit": need.commit or None,
    }


def _show(needs: list[Need], *, everything: bool) -> None:
    console = common.output()
    if not needs:
        console.print("no models to fetch: it works with APIs or with what is installed")
        return
    width = max(len(need.name) for need in needs)
    for need in needs:
        mark = "[green]●[/]" if need.path else "[dim]○[/]"
        last = need.commit[:12] if everything else ", ".join(need.roles)
        end = f"  [dim]{escape(last)}[/]" if last else ""
        console.print(f"{mark} {escape(need.name):{width}} {escape(need.terms)}{end}")
    console.print("[dim]● on this disk   ○ not yet[/]")
    if not everything:
        _advise(console, needs)


def _advise(console: Console, needs: list[Need]) -> None:
    """The command that fetches what is missing, and the setting that pins what is here."""
    absent = [need for need in needs if need.path is None]
    if absent:
        size = sum(need.info.gigabytes or 0 for need in absent)
        names = " ".join(need.reference for need in absent)
        console.print(f"about {size:.1f} GB to fetch: [cyan]a4 models pull {names}[/]")
    pinned = [need for need in needs if need.commit and not need.revision]
    if pinned:
        console.print("[dim]to pin what is here, give the expert the setting revision:[/]")
    for need in pinned:
        console.print(f'[dim]  {need.name}  revision = "{need.commit}"[/]')


def _check_room(needed: int) -> None:
    folder = hub.cache_folder()
    existing = next(place for place in (folder, *folder.parents) if place.exists())
    free = shutil.disk_usage(existing).free
    if needed > free:
        raise ResourceError(
            f"{needed / 1e9:.1f} GB are needed and {free / 1e9:.1f} GB are free in {str(folder)!r}; "
            "make room, or set HF_HOME to a larger disk"
        )
