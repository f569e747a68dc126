"""`a4 tables RUN...`: the paper's tables with these runs beside."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer


def tables(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run folders that `a4 bench` wrote.")],
    form: Annotated[Literal["markdown", "latex", "csv"], typer.Option("--format", "-f")] = "markdown",
    table: Annotated[
        str | None, typer.Option(help="This one: reasonaff, ragnet, umd or ablation-imagination, -components, -stages.")
    ] = None,
) -> None:
    """Print the paper's tables with your runs beside.

    As Markdown, LaTeX or CSV.
    """
    from a4agent.runs.store import read_run
    from a4agent.runs.tables import fill

    print("\n".join(one.render(form) for one in fill([read_run(run) for run in runs], table)), end="")
