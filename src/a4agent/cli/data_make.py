"""`a4 data make sim`: render a benchmark on this machine."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal

import typer

from a4agent.cli import common


def make(
    benchmark: Annotated[Literal["sim"], typer.Argument(metavar="BENCHMARK", help="sim: scenes from simulators.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The folder to write; new, empty, or of a broken-off set.")],
    n: Annotated[int, typer.Option("--n", min=1, help="How many samples.")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same files.")] = 0,
    split: Annotated[
        Literal["dev", "test", "all"], typer.Option(help="Which things to show: dev and test share none.")
    ] = "test",
    workers: Annotated[int | None, typer.Option(min=1, help="Processes, 2 by default; the files are the same.")] = None,
    things: Annotated[Path | None, typer.Option(help="A TOML file that declares other things than ours.")] = None,
) -> None:
    """Render pictures of things to handle, with exact truth: masks, boxes, points, depth and camera.

    Needs the extra `sim` and three packages of assets; where they are missing, the error says how to get them.
    """
    from a4agent.benchmarks.registry import maker_of

    with common.bar() as progress:
        task = progress.add_task("rendering", total=n)
        folder = maker_of(benchmark)(
            out,
            n=n,
            seed=seed,
            split=None if split == "all" else split,
            catalogue_path=things,
            workers=workers or min(2, os.cpu_count() or 1),
            on_sample=lambda done, _: progress.update(task, completed=done),
        )
    print(folder)
