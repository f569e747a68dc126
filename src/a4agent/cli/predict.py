"""`a4 predict IMAGE... "instruction"`: files, folders and globs in, one folder a sample out."""

from __future__ import annotations

import glob
import itertools
import json
import os
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from a4agent.cli import common
from a4agent.cli.common import ProfileOption, SetOption, say
from a4agent.errors import InputError

if TYPE_CHECKING:
    from a4agent.config import Settings
    from a4agent.types import Affordance


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
    from a4agent.imaging.save import make_folder

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
    from a4agent.imaging.load import SUFFIXES, UNREAD, find_images

    *sources, instruction = arguments
    if not sources:
        raise InputError(
            f"an image and an instruction are needed, and there is only {instruction!r};"
            " for instance: a4 predict mug.jpg 'drink from the mug'"
        )
    if not instruction.strip() or os.path.exists(instruction):
        raise InputError(
            f"the last argument is the instruction, not {instruction!r};"
            " put it in quotes at the end: a4 predict mug.jpg 'drink from the mug'"
        )
    images: list[Path] = []
    for source in sources:
        if os.path.isdir(source):
            pictures = find_images(Path(source), SUFFIXES | UNREAD)
            found = [path for path in pictures if path.suffix.lower() in SUFFIXES]
            unread = [path for path in pictures if path.suffix.lower() in UNREAD]
            formats = ", ".join(sorted({path.suffix.lower() for path in unread}))
            if not found and unread:
                raise InputError(f"the folder {source!r} has only {formats} files; convert them to JPEG or PNG")
            if not found:
                raise InputError(f"no images in the folder {source!r}")
            if unread:
                common.warn(
                    f"{len(unread)} files in {source!r} are passed over ({formats}); convert them to JPEG or PNG"
                )
            images += found
        elif not os.path.exists(source) and glob.has_magic(source):
            found = sorted(Path(name) for name in glob.glob(source, recursive=True) if os.path.isfile(name))
            if not found:
                raise InputError(f"nothing matches {source!r}")
            images += found
        else:
            images.append(Path(source))
    return list(dict.fromkeys(images)), instruction


def name_samples(images: list[Path]) -> dict[str, Path]:
    """A name for each image, as short as is unique: mug, mug.jpg, left_mug.jpg, or with a number."""
    taken: set[str] = set()
    name_of: dict[Path, str] = {}
    for form in (
        lambda path: path.stem,
        lambda path: path.name,
        lambda path: f"{path.resolve().parent.name}_{path.name}",
    ):
        alike: defaultdict[str, list[Path]] = defaultdict(list)
        for path in images:
            if path not in name_of:
                alike[form(path).lower()].append(path)
        for name, (first, *others) in alike.items():
            if not others and name not in taken:
                name_of[first] = form(first)
                taken.add(name)
    numbers = itertools.count(1)
    for path in images:
        while path not in name_of:
            name = f"{next(numbers):05d}_{path.name}"
            if name.lower() not in taken:
                name_of[path] = name
    return {name_of[path]: path for path in images}


def _run(settings: Settings, samples: dict[str, Path], instruction: str, out: Path, as_json: bool) -> int:
    """Predict, save and tell; returns how many samples failed."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn

    from a4agent import engine
    from a4agent.types import Query

    queries = (Query(name, path, instruction) for name, path in samples.items())
    failed = 0
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with (
        common.build_agent(settings) as agent,
        common.bar(*columns, hidden=len(samples) == 1) as progress,
    ):
        task = progress.add_task("predicting", total=len(samples))
        for query, affordance in engine.run(agent, queries, settings=settings.engine):
            folder = out / query.id
            saved = True
            try:
                affordance.save(folder)
            except InputError as error:
                saved, affordance = False, replace(affordance, status="error", error=str(error))
            failed += affordance.status in ("error", "invalid")
            if as_json:
                line = {"image": str(query.image), "out": str(folder), **affordance.to_dict()}
                print(json.dumps(line), flush=True)
            elif len(samples) == 1:
                _tell(affordance, folder if saved else None)
            else:
                _tell_in_short(affordance, Path(str(query.image)))
            progress.advance(task)
    if len(samples) > 1:
        done = len(samples) - failed
        say(f"{done} of {len(samples)} done, {failed} failed; answers in {out}/")
    return failed


def _tell_in_short(affordance: Affordance, image: Path) -> None:
    """One answer of many, in a line."""
    from rich.console import Console
    from rich.text import Text

    status = (f"{affordance.status:8}", "green" if affordance.status == "ok" else "red")
    console = Console(highlight=False, emoji=False, soft_wrap=True)
    console.print(Text.assemble(status, f"{image}: {affordance.summary}"))


def _tell(affordance: Affordance, folder: Path | None) -> None:
    """All of an answer in words; `folder` is where its files lie, None if they could not be written."""
    from rich.console import Console
    from rich.text import Text

    console = Console(highlight=False, emoji=False, soft_wrap=True)
    good = affordance.status == "ok"
    rows: list[tuple[str, str]] = [("part" if good else "answer", affordance.summary)]
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
    if folder is not None:
        name, file = ("file", "affordance.json") if affordance.image is None else ("overlay", "overlay.png")
        rows.append((name, str(folder / file)))
    for name, value in rows:
        console.print(Text.assemble((f"{name:>9}  ", "bold cyan"), (value, "" if name != "answer" else "red")))
