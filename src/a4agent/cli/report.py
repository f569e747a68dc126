"""`a4 report RUN`: a run as one HTML file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from a4agent.cli.common import say


def report(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder that `a4 bench` wrote.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="The file; RUN/report.html if not given.")] = None,
    show: Annotated[bool, typer.Option("--open", help="Open it in the browser.")] = False,
) -> None:
    """Write a run as one HTML file.

    It opens without a network, and shows the scores, what fails, and every sample.
    """
    from a4agent.runs.report import write_report
    from a4agent.runs.store import read_run

    path = write_report(read_run(run), out)
    say(f"{path.stat().st_size / 1e6:.1f} MB, opens in any browser:")
    print(path)
    if show:
        import webbrowser

        webbrowser.open(path.resolve().as_uri())
