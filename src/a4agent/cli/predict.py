"""`a4 predict IMAGE... "instruction"`: files, folders and globs in, one folder a sample out."""

from __future__ import annotations

import glob
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from a4agent.cli import common
from a4agent.cli.common import ProfileOption, SetOption, messages
from a4agent.errors import InputError

if TYPE_CHECKING:
    from a4agent.affordance import Affordance
    from a4agent.config import Settings


def predict(
    arguments: Annotated[
        list[str],
        typer.Argument(metavar='IMAGE... "INSTRUCTION"', help="Image files, folders or globs; then what to do."),
    ],
    profile: ProfileOption = None,
    sets: SetOption = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="A folder a sample is made in here.")] = Path("out"),
    as_json: Annotated[bool, typer.Option("--json", help="Print each answer as a line of JSON.")] = False,
    cache: Annotated[str | None, typer.Option(help="off, read or write: reuse answers kept on disk.")] = None,
    max_cost: Annotated[float | None, typer.Option(help="Stop at this many US dollars.")] = None,
) -> None:
    """Find the part to act on, in images, folders or globs.

    Writes OUT/NAME/ with affordance.json, mask.png, overlay.png and, when dreamt, imagination.png.
    """
    from a4agent.saving import make_folder

    images, instruction = split_arguments(arguments)
    settings = common.settings(profile, sets, engine__cache=cache, engine__max_cost=max_cost)
    make_folder(out)
    failed = _run(settings, name_samples(images), instruction, out, as_json)
    raise typer.Exit(common.SOME_FAILED if failed else common.OK)


def split_arguments(arguments: list[str]) -> tuple[list[Path], str]:
    """The images that the arguments name, and the instruction behind them.

    Raises:
        InputError: no image, no instruction, an empty folder or a glob that matches nothing.
    """
    from a4agent.images import find_images

    *sources, instruction = arguments
    if not sources:
        raise InputError(
            f"an image and an instruction are needed, and there is only {instruction!r};"
            " for instance: a4 predict mug.jpg 'drink from the mug'"
        )
    if not instruction.strip() or Path(instruction).exists():
        raise InputError(
            f"the last argument is the instruction, not {instruction!r};"
            " put it in quotes at the end: a4 predict mug.jpg 'drink from the mug'"
        )
    images: list[Path] = []
    for source in sources:
        path = Path(source)
        if path.is_dir():
            found = find_images(path)
            if not found:
                raise InputError(f"no images in the folder {source!r}")
            images += found
        elif not path.exists() and glob.has_magic(source):
            found = sorted(Path(name) for name in glob.glob(source, recursive=True) if Path(name).is_file())
            if not found:
                raise InputError(f"nothing matches {source!r}")
            images += found
        else:
            images.append(path)
    return list(dict.fromkeys(images)), instruction


def name_samples(images: list[Path]) -> dict[str, Path]:
    """A name for each image, as short as is unique: mug, mug.jpg, left_mug.jpg, or with a number."""
    names: dict[str, Path] = {}
    left = images
    for name_of in (
        lambda path: path.stem,
        lambda path: path.name,
        lambda path: f"{path.resolve().parent.name}_{path.name}",
    ):
        counts = Counter(name_of(path).lower() for path in left)
        alone = [p for p in left if counts[name_of(p).lower()] == 1 and name_of(p).lower() not in map(str.lower, names)]
        names.update({name_of(path): path for path in alone})
        left = [path for path in left if path not in alone]
    for number, path in enumerate(left, 1):
        names[f"{number:05d}_{path.name}"] = path
    order = {path: place for place, path in enumerate(images)}
    return dict(sorted(names.items(), key=lambda item: order[item[1]]))


def _run(settings: Settings, samples: dict[str, Path], instruction: str, out: Path, as_json: bool) -> int:
    """Predict, save and tell; returns how many samples failed."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from a4agent import engine
    from a4agent.affordance import Query

    queries = (Query(name, path, instruction) for name, path in samples.items())
    failed = 0
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with (
        common.build_agent(settings) as agent,
        Progress(*columns, console=messages, transient=True, disable=len(samples) == 1) as progress,
    ):
        task = progress.add_task("predicting", total=len(samples))
        for query, affordance in engine.run(agent, queries, settings=settings.engine):
            folder = out / query.id
            try:
                affordance.save(folder)
            except InputError as error:
                affordance = replace(affordance, status="error", error=str(error))
            failed += affordance.status in ("error", "invalid")
            if as_json:
                line = {"image": str(query.image), "out": str(folder), **affordance.to_dict()}
                print(json.dumps(line, ensure_ascii=False), flush=True)
            else:
                _tell(affordance, Path(str(query.image)), folder, alone=len(samples) == 1)
            progress.advance(task)
    if len(samples) > 1:
        messages.print(f"{len(samples) - failed} of {len(samples)} done, {failed} failed; answers in {out}/")
    return failed


def _tell(affordance: Affordance, image: Path, folder: Path, *, alone: bool) -> None:
    """The answer in words: one line of many, or all of a single one."""
    from rich.console import Console
    from rich.text import Text

    from a4agent.overlay import caption_of

    console = Console(highlight=False, soft_wrap=True)
    good = affordance.status == "ok"
    if not alone:
        console.print(
            Text.assemble((f"{affordance.status:8}", "green" if good else "red"), f"{image}: {caption_of(affordance)}")
        )
        return
    rows: list[tuple[str, str]] = [("part" if good else "answer", caption_of(affordance))]
    if affordance.target and affordance.target.thinking:
        rows.append(("thinking", affordance.target.thinking))
    if affordance.imagination:
        rows.append(("imagined", affordance.imagination.prompt))
    if affordance.status == "ok":
        share = affordance.mask.mean() if affordance.mask.size else 0.0
        rows.append(("box", "; ".join(", ".join(f"{x:.0f}" for x in box) for box in affordance.boxes_xyxy) or "none"))
        rows.append(("points", "; ".join(f"({x:.0f}, {y:.0f})" for x, y in affordance.points_xy) or "none"))
        rows.append(("mask", f"{int(affordance.mask.sum())} pixels, {share:.1%} of the image"))
    cost = f", ${affordance.trace.cost:.4f}" if affordance.trace.cost else ""
    rows.append(("took", f"{affordance.trace.seconds:.2f} s in {len(affordance.trace.steps)} model calls{cost}"))
    rows.append(("overlay" if affordance.image is not None else "file", str(_shown(affordance, folder))))
    for name, value in rows:
        console.print(Text.assemble((f"{name:>9}  ", "bold cyan"), (value, "" if name != "answer" else "red")))


def _shown(affordance: Affordance, folder: Path) -> Path:
    return folder / ("overlay.png" if affordance.image is not None else "affordance.json")
