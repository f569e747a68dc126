"""`a4 score`: masks that another system wrote, scored like our own; and scores as lines of text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import typer

from a4agent import metrics
from a4agent.benchmarks.base import Benchmark
from a4agent.benchmarks.predictions import Predictions
from a4agent.cli import common
from a4agent.cli.common import DataOption, JsonOption, NameArgument, OptionsOption, ProtocolOption, opened
from a4agent.errors import ConfigError, DataError
from a4agent.metrics import MEASURES, Scores
from a4agent.runs.external import MISSING, ScoredSample, outcomes_of, score_predictions, write_run
from a4agent.runs.manifest import LEAKS
from a4agent.runs.scores import Mean, measure_name
from a4agent.runs.trust import MEASURES as FIGURES
from a4agent.runs.trust import Trust

SHOWN = 5
LeakOption = Annotated[
    list[str] | None,
    typer.Option(
        "--leak",
        metavar="NAME=yes|no",
        help="trained: on this data. truth: seen by a memory. shared: test images in a memory or template bank.",
    ),
]


def score(
    benchmark: NameArgument,
    predictions: Annotated[
        Path, typer.Option(help="A folder with one <id>.png a sample, or a JSON file of COCO RLE by id.")
    ],
    data: DataOption,
    protocol: ProtocolOption = None,
    option: OptionsOption = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Keep them as a run folder, for report, compare and tables.")
    ] = None,
    label: Annotated[
        str | None, typer.Option(help="The system's name in those, such as LISA-7B; else that of the predictions.")
    ] = None,
    leak: LeakOption = None,
    resize: Annotated[
        bool, typer.Option("--resize", help="Stretch masks that are over 4 times larger or smaller than the truth.")
    ] = False,
    by_category: Annotated[bool, typer.Option("--by-category", help="Also score each category.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Score masks that another system wrote.

    A sample without a readable mask has failed. `a4 data queries` prints the ids, pictures and
    instructions to give to that system.
    """
    opened_data = opened(benchmark, data, option, empty=False)
    protocol = protocol or opened_data.protocol
    metrics.protocol_of(protocol)
    leaks = leaks_of(leak)
    masks = Predictions(predictions)
    _check_names(opened_data, masks)
    with common.bar() as progress:
        task = progress.add_task("scoring", total=len(opened_data))

        def advance() -> None:
            progress.advance(task)

        if out is not None:
            name = label or masks.path.stem
            kept = write_run(
                opened_data, masks, out, name=name, protocol=protocol, leaks=leaks, resize=resize, progress=advance
            )
            outcomes = list(outcomes_of(kept))
        else:
            outcomes: list[ScoredSample] = []
            for outcome in score_predictions(opened_data, masks, resize=resize):
                outcomes.append(outcome)
                advance()
    _report_problems(outcomes, masks)
    if out is not None:
        common.say(f"kept as a run in {out}/")
    rows = [outcome.row for outcome in outcomes]
    whole = metrics.score(rows, protocol)
    groups = metrics.score_by(rows, [outcome.category for outcome in outcomes], protocol) if by_category else {}
    if as_json:
        categories = {"categories": {name: scores.to_dict() for name, scores in groups.items()}} if groups else {}
        common.print_json({"benchmark": opened_data.fingerprint(), "scores": whole.to_dict(), **categories})
    else:
        print(f"{opened_data.name}, protocol {whole.protocol}, {opened_data.licence}")
        show_scores(whole, groups)
    if whole.n_failed:
        raise typer.Exit(common.SOME_FAILED)


def leaks_of(texts: Sequence[str] | None) -> dict[str, str]:
    """What `--leak` declares.

    Raises:
        ConfigError: not NAME=yes or NAME=no with a known name.
    """
    found: dict[str, str] = {}
    for text in texts or ():
        name, _, answer = text.partition("=")
        if name not in LEAKS or answer not in ("yes", "no", "unknown"):
            raise ConfigError(
                f"--leak takes trained, truth or shared with =yes or =no (such as trained=no), not {text!r}"
            )
        found[name] = answer
    return found


def _check_names(data: Benchmark, masks: Predictions) -> None:
    """Raise DataError before any work if no prediction belongs to a sample."""
    ids = [sample.id for sample in data]
    if not any(map(masks.has, ids)):
        strays = masks.strays(ids)
        wanted = ", ".join(f"{identity}.png" for identity in ids[:3])
        raise DataError(
            f"no prediction in {str(masks.path)!r} belongs to a sample: they are named by id, such as {wanted}"
            + (f"; found {', '.join(strays[:3])}" if strays else "")
        )


def _report_problems(outcomes: list[ScoredSample], masks: Predictions) -> None:
    """Warn of missing, stray and resized predictions, which a wrong file would have."""
    strays = masks.strays(outcome.id for outcome in outcomes)
    missing = [outcome.id for outcome in outcomes if outcome.problem == MISSING]
    resized = [outcome.id for outcome in outcomes if outcome.row.resized]
    if missing:
        common.warn(
            f"no prediction for {len(missing)} of {len(outcomes)} samples, which count as failed: {_some(missing)}"
        )
    for problem in [outcome.problem for outcome in outcomes if outcome.problem not in ("", MISSING)][:SHOWN]:
        common.warn(problem)
    if resized:
        common.warn(f"{len(resized)} masks were resized to the truth's size: {_some(resized)}")
    if strays:
        common.warn(f"predictions for no sample: {len(strays)} ({_some(strays)})")


def _some(names: list[str]) -> str:
    return ", ".join(names[:SHOWN]) + (", ..." if len(names) > SHOWN else "")


def show_scores(
    whole: Scores,
    groups: Mapping[str, Scores] | None = None,
    measures: Mapping[str, Mean] | None = None,
    trust: Trust | None = None,
) -> None:
    """Print the counts, each measure in percent with its 95 % interval, then a row per group."""
    print(
        f"n {whole.n}  scored {whole.n_scored}  failed {whole.n_failed}  empty truth {whole.n_empty_truth}  "
        f"empty prediction {whole.n_empty_prediction}  resized {whole.n_resized}"
    )
    wide = 15 if trust else 13 if measures else 8
    for name, label in MEASURES.items():
        low, high = whole.intervals[name]
        print(f"{label:<{wide}}{percent(getattr(whole, name))}   95% {percent(low)} to {percent(high)}")
    for name, mean in (measures or {}).items():
        shown = percent if name == "contact" else _plain
        print(f"{measure_name(name):<{wide}}{shown(mean.value)}   95% {shown(mean.low)} to {shown(mean.high)}")
    if trust:
        _show_trust(trust)
    width = max(map(len, groups or ()), default=0)
    for group, scores in sorted((groups or {}).items()):
        values = "  ".join(f"{label} {percent(getattr(scores, name))}" for name, label in MEASURES.items())
        print(f"  {group:<{width}}  n {scores.n:<5} {values}")


def _show_trust(found: Trust) -> None:
    at = "" if found.accept is None else f", accepted from {found.accept:g}"
    print(f"confidence of {found.n_rated} of {found.n} answers{at}, {found.n_abstained} abstained")
    for name, label in FIGURES.items():
        low, high = found.intervals[name]
        print(f"{label:<15}{percent(found.values[name])}   95% {percent(low)} to {percent(high)}")


def percent(value: float) -> str:
    """A share of 1 in percent; "-" for NaN."""
    return "     -" if value != value else f"{100 * value:6.2f}"


def _plain(value: float) -> str:
    return f"{value:6.3f}"
