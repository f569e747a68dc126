"""Runs side by side on the samples they share, and what each stage costs.

Every run is compared with the first. Differences are paired, with 95 % intervals. Runs that differ only in
their oracle make a table of losses: the cost of each stage in gIoU.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from a4agent import metrics
from a4agent.errors import DataError
from a4agent.metrics import Comparison, Difference
from a4agent.runs import scores, trust
from a4agent.runs.manifest import differences
from a4agent.runs.oracle import ORACLES, Oracle
from a4agent.runs.store import Run
from a4agent.types import finite_or_none


@dataclass(frozen=True)
class ComparedLine:
    """One measure of two runs and its paired change; `percent` marks shares of 1."""

    name: str
    label: str
    first: float
    second: float
    change: Difference
    percent: bool = True


@dataclass(frozen=True)
class RunPair:
    """Two runs: `changed` lists how their configurations differ.

    `measures` are contact hits and what the benchmark adds; `trust` rates the confidences, where both runs have them.
    """

    first: Run
    second: Run
    result: Comparison
    changed: tuple[str, ...]
    measures: tuple[ComparedLine, ...] = ()
    trust: tuple[ComparedLine, ...] = ()

    def lines(self) -> list[ComparedLine]:
        """All measures that are defined, the masks' first."""
        masks = [
            ComparedLine(name, label, first, getattr(self.result.second, name), self.result.differences[name])
            for name, label in metrics.MEASURES.items()
            if (first := getattr(self.result.first, name)) == first
        ]
        return [*masks, *self.measures, *self.trust]


@dataclass(frozen=True)
class Loss:
    """What a stage costs: `giou` is the score with the truth for it and all before it, `cost` what that gains."""

    stage: str
    giou: float
    cost: Difference | None


def compare(first: Run, second: Run, protocol: str | None = None) -> RunPair:
    """Two runs on their shared samples, by the first one's protocol unless another is named.

    Raises:
        DataError: they share no sample, or were scored against different truths.
    """
    protocol = protocol or scores.protocol_of(first)
    try:
        result = metrics.compare(scores.rows_of(first), scores.rows_of(second), protocol)
    except DataError as error:
        raise DataError(f"{str(first.folder)!r} and {str(second.folder)!r}: {error}") from error
    _same_truths(first, second, result)
    configurations = [_configuration(run) for run in (first, second)]
    if first.external or second.external:  # only the name of another system is known
        for run, found in zip((first, second), configurations, strict=True):
            found.update(settings=None, experts=None, prompts=None, system=run.manifest.label)
    changed = differences(configurations[0], configurations[1])
    measures = [
        ComparedLine(name, scores.measure_name(name), one.value, two.value, change, name == "contact")
        for name, (one, two, change) in scores.measure_changes(first, second).items()
    ]
    figures = [
        ComparedLine(name, trust.MEASURES[name], *values, change)
        for name, (values, change) in (trust.compare(first, second) or {}).items()
    ]
    return RunPair(first, second, result, tuple(changed), tuple(measures), tuple(figures))


def _same_truths(first: Run, second: Run, result: Comparison) -> None:
    """Raise DataError if a true mask differs, also where its area is the same."""
    for id, record in first.records.items():
        other = second.records.get(id)
        if other is None or None in (record.scored.truth_pixels, other.scored.truth_pixels):
            continue  # where several masks are right, a record keeps the one closest to its answer
        if record.truth != other.truth:
            raise DataError(
                f"{str(first.folder)!r} and {str(second.folder)!r}: the true mask of {id!r} is not the same in both,"
                f" so they cannot be compared; {result.n_shared} samples are shared"
            )


def losses(runs: Sequence[Run], protocol: str | None = None) -> list[list[Loss]]:
    """A table of losses for each configuration that has runs with oracles, in the order of the stages.

    The first line is the run without an oracle. Each cost is paired with the line before.
    """
    groups: list[list[Run]] = []
    for run in runs:
        group = next(
            (g for g in groups if not differences(_configuration(g[0], False), _configuration(run, False))), None
        )
        if group is None:
            groups.append([run])
        elif _oracle(run) not in map(_oracle, group):
            group.append(run)
    tables: list[list[Loss]] = []
    for group in groups:
        group.sort(key=lambda run: (None, *ORACLES).index(_oracle(run)))
        if len(group) < 2:
            continue
        lines = [Loss(_stage(group[0]), scores.score(group[0], protocol).giou, None)]
        for before, after in pairwise(group):
            result = compare(before, after, protocol).result
            lines.append(Loss(_stage(after), result.second.giou, result.differences["giou"]))
        tables.append(lines)
    return tables


def to_dict(pairs: Sequence[RunPair], tables: Sequence[Sequence[Loss]]) -> dict[str, Any]:
    """Ready for `json.dumps`."""
    return {
        "pairs": [
            {
                "first": str(pair.first.folder),
                "second": str(pair.second.folder),
                "changed": list(pair.changed),
                "protocol": pair.result.first.protocol,
                "shared": pair.result.n_shared,
                "only_first": pair.result.n_only_first,
                "only_second": pair.result.n_only_second,
                "scores": [pair.result.first.to_dict(), pair.result.second.to_dict()],
                "differences": {name: change.to_dict() for name, change in pair.result.differences.items()},
                "measures": _lines_to_dict(pair.measures),
                "trust": _lines_to_dict(pair.trust),
                "statuses": [scores.statuses(run) for run in (pair.first, pair.second)],
                "gained": list(pair.result.gained),
                "lost": list(pair.result.lost),
            }
            for pair in pairs
        ],
        "losses": [
            [
                {"stage": line.stage, "giou": finite_or_none(line.giou), "cost": line.cost and line.cost.to_dict()}
                for line in table
            ]
            for table in tables
        ],
    }


def _configuration(run: Run, with_oracle: bool = True) -> dict[str, Any]:
    identity = run.manifest.identity
    keys = ("benchmark", "data", "selection", "oracle", "settings", "experts", "prompts")
    return {key: identity.get(key) for key in keys if key != "oracle" or with_oracle}


def _oracle(run: Run) -> Oracle | None:
    return run.manifest.identity.get("oracle")


def _stage(run: Run) -> str:
    return _oracle(run) or "the run as it is"


def _lines_to_dict(lines: Sequence[ComparedLine]) -> dict[str, Any]:
    return {
        line.name: {"values": [finite_or_none(line.first), finite_or_none(line.second)], **line.change.to_dict()}
        for line in lines
    }
