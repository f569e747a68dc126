"""`a4 score`: masks that another system's own code wrote, scored like everything else."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from a4agent.cli import common, scores_text
from a4agent.cli.benchmark_data import DataOption, NameArgument, OptionsOption, RuleOption, opened, with_samples
from a4agent.errors import DataError

if TYPE_CHECKING:
    from a4agent.benchmarks.base import Benchmark
    from a4agent.benchmarks.predictions import Predictions
    from a4agent.metrics import Scores
    from a4agent.runs.external import Outcome

SHOWN = 5


def score(
    benchmark: NameArgument,
    predictions: Annotated[
        Path, typer.Option(help="A folder with one <id>.png a sample, or a JSON file of COCO RLE by id.")
    ],
    data: DataOption,
    protocol: Annotated[str | None, typer.Option(help="strict, affordance-r1, affordance-r1-umd or ragnet.")] = None,
    rule: RuleOption = None,
    option: OptionsOption = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Keep them as a run folder, for report, compare and tables.")
    ] = None,
    label: Annotated[
        str | None, typer.Option(help="The system's name in those, such as LISA-7B; else that of the predictions.")
    ] = None,
    by_category: Annotated[bool, typer.Option("--by-category", help="Also score each category.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print as JSON.")] = False,
) -> None:
    """Score masks that another system wrote.

    A sample without a readable mask has failed. `a4 data queries` prints the ids, pictures and
    instructions to give to that system.
    """
    from a4agent import metrics
    from a4agent.benchmarks.predictions import Predictions
    from a4agent.runs.external import score_predictions, write_run

    opened_data = with_samples(opened(benchmark, data, rule, option))
    protocol = protocol or opened_data.protocol
    metrics.protocol_of(protocol)
    masks = Predictions(predictions)
    outcomes: list[Outcome] = []
    with common.bar() as progress:
        task = progress.add_task("scoring", total=len(opened_data))
        for outcome in score_predictions(opened_data, masks):
            outcomes.append(outcome)
            progress.advance(task)
    _report_problems(outcomes, masks)
    rows = [outcome.row for outcome in outcomes]
    if out is not None:
        write_run(opened_data, masks, out, name=label or masks.path.stem, protocol=protocol)
        common.say(f"kept as a run in {out}/")
    whole = metrics.score(rows, protocol)
    groups = metrics.score_by(rows, [outcome.category for outcome in outcomes], protocol) if by_category else {}
    if as_json:
        print(json.dumps(_as_dict(opened_data, whole, groups), indent=1))
    else:
        _show(opened_data, whole, groups)
    if whole.n_failed:
        raise typer.Exit(common.SOME_FAILED)


def _report_problems(outcomes: list[Outcome], masks: Predictions) -> None:
    """Say what was not found or not asked for; both are what a wrong file name looks like.

    Raises:
        DataError: no prediction is for any sample.
    """
    from a4agent.runs.external import MISSING

    strays = masks.strays(outcome.id for outcome in outcomes)
    missing = [outcome.id for outcome in outcomes if outcome.problem == MISSING]
    if len(missing) == len(outcomes):
        wanted = ", ".join(f"{identity}.png" for identity in missing[:3])
        raise DataError(
            f"no prediction in {str(masks.path)!r} belongs to a sample: they are named by id, such as {wanted}"
            + (f"; found {', '.join(strays[:3])}" if strays else "")
        )
    if missing:
        common.warn(
            f"no prediction for {len(missing)} of {len(outcomes)} samples, which count as failed: {_some(missing)}"
        )
    for problem in [outcome.problem for outcome in outcomes if outcome.problem not in ("", MISSING)][:SHOWN]:
        common.warn(problem)
    if strays:
        common.warn(f"predictions for no sample: {len(strays)} ({_some(strays)})")


def _some(names: list[str]) -> str:
    return ", ".join(names[:SHOWN]) + (", ..." if len(names) > SHOWN else "")


def _as_dict(data: Benchmark, whole: Scores, groups: dict[str, Scores]) -> dict[str, Any]:
    categories = {"categories": {name: scores.to_dict() for name, scores in groups.items()}} if groups else {}
    return {"benchmark": data.fingerprint(), "scores": whole.to_dict(), **categories}


def _show(data: Benchmark, whole: Scores, groups: dict[str, Scores]) -> None:
    from a4agent.metrics import MEASURES

    print(f"{data.name}, protocol {whole.protocol}, {data.licence}")
    print("\n".join(scores_text.lines(whole)))
    width = max(map(len, groups), default=0)
    for group, scores in sorted(groups.items()):
        values = "  ".join(f"{label} {scores_text.percent(getattr(scores, name))}" for name, label in MEASURES.items())
        print(f"  {group:<{width}}  n {scores.n:<5} {values}")
