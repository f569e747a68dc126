"""`a4 data make sim`: render a benchmark on this machine."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal

import typer

from a4agent.cli import common

app = typer.Typer(help="Make benchmark data.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Make benchmark data."""


@app.command("sim")
def make_sim(
    out: Annotated[Path, typer.Option("--out", help="The folder to write; new or empty.")],
    n: Annotated[int, typer.Option("--n", min=1, help="How many samples.")] = 200,
    seed: Annotated[int, typer.Option("--seed", min=0, help="The same seed gives the same files.")] = 0,
    split: Annotated[
        Literal["dev", "test", "all"], typer.Option("--split", help="Which things to show: the splits share none.")
    ] = "test",
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes; the files do not depend on it.")] = min(
        2, os.cpu_count() or 1
    ),
    things: Annotated[Path | None, typer.Option("--things", help="A TOML file of things instead of ours.")] = None,
) -> None:
    """Render pictures of articulated and handled things with exact truth: masks, boxes, points, depth, camera.

    Needs the extra `sim` and three asset packages; the error says how to get them.
    """
    from rich.progress import Progress

    from a4agent.sim.make import make_set

    with Progress(console=common.messages, transient=True) as progress:
        bar = progress.add_task("rendering", total=n)
        folder = make_set(
            out,
            n=n,
            seed=seed,
            split=None if split == "all" else split,
            catalogue_path=things,
            workers=workers,
            on_sample=lambda done, _: progress.update(bar, completed=done),
        )
    print(folder)
