"""`a4 report`, `compare`, `tables` and `calibrate`: what to do with run folders."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from a4agent.cli import common
from a4agent.errors import ConfigError
from a4agent.metrics import Difference
from a4agent.runs import scores
from a4agent.runs.calibrate import fit
from a4agent.runs.compare import Loss, RunPair, losses, to_dict
from a4agent.runs.compare import compare as compare_two
from a4agent.runs.report import write_comparison, write_report
from a4agent.runs.store import read_run, write_atomically
from a4agent.runs.tables import fill

SHOWN = 12
RunsArgument = Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run folders that `a4 bench` wrote.")]
OpenOption = Annotated[bool, typer.Option("--open", help="Open it in the browser.")]


def report(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder that `a4 bench` wrote.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="The file; RUN/report.html if not given.")] = None,
    show: OpenOption = False,
) -> None:
    """Write a run as one HTML file.

    It opens without a network, and shows the scores, what fails, and every sample.
    """
    _announce(write_report(read_run(run), out), show)


def compare(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN RUN...", help="Run folders; the first is the reference.")],
    protocol: common.ProtocolOption = None,
    html: Annotated[
        Path | None, typer.Option("--html", metavar="FILE", help="Write two runs side by side as one HTML page.")
    ] = None,
    show: OpenOption = False,
    as_json: common.JsonOption = False,
) -> None:
    """Compare runs on the samples they share.

    Each is compared with the first one. Runs that differ only in their oracle also make a table of what
    each stage costs.
    """
    if len(runs) < 2:
        raise ConfigError("a comparison takes two runs or more: a4 compare RUN RUN...")
    if html and len(runs) > 2:
        raise ConfigError(f"--html shows two runs side by side, not {len(runs)}; name two of them")
    opened = [read_run(run) for run in runs]
    pairs = [compare_two(opened[0], run, protocol) for run in opened[1:]]
    tables = losses(opened, protocol)
    if html:
        _announce(write_comparison(pairs[0], html), show)
    elif as_json:
        common.print_json(to_dict(pairs, tables))
    else:
        for pair in pairs:
            _show_pair(pair)
        for table in tables:
            _show_losses(table)
    if any(not run.complete for run in opened):
        common.warn("a run is not complete; only its samples so far are compared")


def tables(
    runs: RunsArgument,
    form: Annotated[Literal["markdown", "latex", "csv"], typer.Option("--format", "-f")] = "markdown",
    table: Annotated[
        str | None, typer.Option(help="This one: reasonaff, ragnet, umd or ablation-imagination, -components, -stages.")
    ] = None,
) -> None:
    """Print the paper's tables with your runs in them.

    As Markdown, LaTeX or CSV.
    """
    print("\n".join(one.render(form) for one in fill([read_run(run) for run in runs], table)), end="")


def calibrate(
    runs: RunsArgument,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="The calibration file to write.")],
    kind: Annotated[
        Literal["logistic", "isotonic"], typer.Option(help="isotonic follows any shape and wants hundreds of answers.")
    ] = "logistic",
) -> None:
    """Fit a verifier's confidence to scored runs.

    The file turns the checks of an answer into the probability that its mask is right (IoU of 0.5 or more). Use it
    with `verifier.calibration = "FILE"`.
    """
    found = fit([read_run(run) for run in runs], kind)
    write_atomically(out, (json.dumps(found.to_dict(), indent=1) + "\n").encode())
    card = found.card
    print(f"{card['n']} answers on {card['images']} images, {card['right']} right; held out, {card['folds']} folds:")
    print(f"AUROC {card['auroc']:.3f}   ECE {card['ece']:.3f}   Brier {card['brier']:.3f}")
    for name, coefficient in sorted(zip(found.features, found.coefficients, strict=True), key=lambda one: -abs(one[1])):
        print(f"  {name:<24} {coefficient:+.3f}")
    common.say(f"to use it: --set verifier.calibration={out}")


def _announce(path: Path, show: bool) -> None:
    common.say(f"{path.stat().st_size / 1e6:.1f} MB, opens in any browser:")
    print(path)
    if show:
        import webbrowser

        webbrowser.open(path.resolve().as_uri())


def _show_pair(pair: RunPair) -> None:
    result = pair.result
    print(f"{pair.first.folder}  ->  {pair.second.folder}")
    print(
        f"{result.n_shared} shared samples, {result.n_only_first} only in the first, {result.n_only_second} only"
        f" in the second; protocol {result.first.protocol}"
    )
    for line in pair.changed[:SHOWN]:
        print(f"  {line.replace(' there, ', ' -> ').removesuffix(' here')}")
    print(f"{'':<15} {'first':>7} {'second':>7} {'change':>7}   95% of the change")
    for line in pair.lines():
        mark = "  clear" if line.change.clear else ""
        scale = 100 if line.percent else 1
        print(
            f"{line.label:<15} {scale * line.first:7.2f} {scale * line.second:7.2f} {_change(line.change, scale)}{mark}"
        )
    abstained = [scores.statuses(run).get("abstained", 0) for run in (pair.first, pair.second)]
    if any(abstained):
        print(f"abstained: {abstained[0]} -> {abstained[1]}")
    print(f"crossed IoU 0.5 upwards: {_some(result.gained)}")
    print(f"crossed IoU 0.5 downwards: {_some(result.lost)}")
    print()


def _show_losses(table: Sequence[Loss]) -> None:
    print("what each stage costs, in gIoU (the truth in its place, and in the place of those before)")
    print(f"{'':<20} {'gIoU':>7} {'cost':>7}   95% of the cost")
    for line in table:
        print(f"{line.stage:<20} {100 * line.giou:7.2f} {_change(line.cost) if line.cost else ''}".rstrip())
    print()


def _change(found: Difference, scale: int = 100) -> str:
    return f"{scale * found.value:+7.2f}   {scale * found.low:+.2f} to {scale * found.high:+.2f}"


def _some(ids: Sequence[str]) -> str:
    more = f" and {len(ids) - SHOWN} more" if len(ids) > SHOWN else ""
    return f"{len(ids)}" + (f" ({', '.join(ids[:SHOWN])}{more})" if ids else "")
