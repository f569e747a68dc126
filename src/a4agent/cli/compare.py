"""`a4 compare RUN RUN...`: differences with intervals, samples that flipped, and what each stage costs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from a4agent.cli import common
from a4agent.errors import ConfigError

if TYPE_CHECKING:
    from a4agent.metrics import Difference
    from a4agent.runs.compare import Loss, Pair

SHOWN = 12


def compare(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN RUN...", help="Run folders; the first is the reference.")],
    protocol: Annotated[str | None, typer.Option(help="strict, affordance-r1, affordance-r1-umd or ragnet.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print as JSON.")] = False,
) -> None:
    """Compare runs on the samples they share.

    Each is compared with the first one. Runs that differ only in their oracle also make a table of what
    each stage costs.
    """
    from a4agent.runs.compare import compare as compare_two
    from a4agent.runs.compare import losses, to_dict
    from a4agent.runs.store import read_run

    if len(runs) < 2:
        raise ConfigError("a comparison takes two runs or more: a4 compare RUN RUN...")
    opened = [read_run(run) for run in runs]
    pairs = [compare_two(opened[0], run, protocol) for run in opened[1:]]
    tables = losses(opened, protocol)
    if as_json:
        print(json.dumps(to_dict(pairs, tables), indent=1))
        return
    for pair in pairs:
        _show_pair(pair)
    for table in tables:
        _show_losses(table)
    if any(not run.complete for run in opened):
        common.warn("a run is not complete; the comparison is of what there is")


def _show_pair(pair: Pair) -> None:
    from a4agent.metrics import MEASURES

    result = pair.result
    print(f"{pair.first.folder}  ->  {pair.second.folder}")
    print(
        f"{result.n_shared} shared samples, {result.n_only_first} only in the first, {result.n_only_second} only"
        f" in the second; protocol {result.first.protocol}"
    )
    for line in pair.changed[:SHOWN]:
        print(f"  {line.replace(' there, ', ' -> ').removesuffix(' here')}")
    print(f"{'':<8} {'first':>7} {'second':>7} {'change':>7}   95% of the change")
    for name, label in MEASURES.items():
        first, second = getattr(result.first, name), getattr(result.second, name)
        if first == first:
            mark = "  clear" if result.differences[name].clear else ""
            print(f"{label:<8} {100 * first:7.2f} {100 * second:7.2f} {_change(result.differences[name])}{mark}")
    print(f"crossed IoU 0.5 upwards: {_some(result.gained)}")
    print(f"crossed IoU 0.5 downwards: {_some(result.lost)}")
    print()


def _show_losses(table: Sequence[Loss]) -> None:
    print("what each stage costs, in gIoU (the truth in its place, and in the place of those before)")
    print(f"{'':<20} {'gIoU':>7} {'cost':>7}   95% of the cost")
    for line in table:
        print(f"{line.stage:<20} {100 * line.giou:7.2f} {_change(line.cost) if line.cost else ''}".rstrip())
    print()


def _change(found: Difference) -> str:
    return f"{100 * found.value:+7.2f}   {100 * found.low:+.2f} to {100 * found.high:+.2f}"


def _some(ids: Sequence[str]) -> str:
    more = f" and {len(ids) - SHOWN} more" if len(ids) > SHOWN else ""
    return f"{len(ids)}" + (f" ({', '.join(ids[:SHOWN])}{more})" if ids else "")
