"""The scores of a run: overall, by category and tag, and why each sample missed."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from math import isnan
from typing import Any

import numpy as np

from a4agent import metrics
from a4agent.metrics import Difference, Row, Scores
from a4agent.runs import trust
from a4agent.runs.store import Record, Run, write_atomically

OUTCOMES = ("hit", "too much", "too little", "partly", "elsewhere", "nothing found", "unreadable", "failed")
"""How a sample can end, best first; see `outcome`."""


def protocol_of(run: Run) -> str:
    """The protocol of the run."""
    return str(run.manifest.identity["protocol"])


def rows_of(run: Run) -> dict[str, Row]:
    """The rows for the metrics, by sample id."""
    return {id: record.scored for id, record in run.records.items()}


def score(run: Run, protocol: str | None = None) -> Scores:
    """The scores of the records so far, by the run's own protocol unless another is named."""
    return metrics.score(rows_of(run).values(), protocol or protocol_of(run))


def by_group(run: Run, protocol: str | None = None) -> dict[str, dict[str, Scores]]:
    """The scores by "category" and by each tag of the samples, worst gIoU first, NaN last.

    Groups without a name and tags that equal the category are left out.
    """
    records = list(run.records.values())
    columns = {"category": [record.category for record in records]}
    for tag in dict.fromkeys(tag for record in records for tag in record.tags):
        values = [record.tags.get(tag, "") for record in records]
        if values != columns["category"]:
            columns[tag] = values
    found: dict[str, dict[str, Scores]] = {}
    for name, values in columns.items():
        if any(values):
            groups = metrics.score_by([r.scored for r in records], values, protocol or protocol_of(run))
            found[name] = dict(sorted(groups.items(), key=lambda item: (isnan(item[1].giou), item[1].giou, item[0])))
    return found


def outcome(record: Record) -> str:
    """Why a sample scored as it did, from its areas.

    hit: IoU over 0.5. too much: most of the truth found, and more than as much again. too little: most of
    what was found is right, and most of the truth left out. elsewhere: under a tenth shared. partly: the rest.
    """
    if record.status == "error":
        return "failed"
    if record.status == "invalid":
        return "unreadable"
    row = record.scored
    if row.union == 0 or 2 * row.intersection > row.union:
        return "hit"
    if not row.prediction_pixels:
        return "nothing found"
    found = row.prediction_pixels
    truth = row.union - found + row.intersection
    if 10 * row.intersection < row.union and 2 * row.intersection < max(truth, 1) and 2 * row.intersection < found:
        return "elsewhere"
    if 2 * row.intersection >= truth:
        return "too much"
    return "too little" if 2 * row.intersection >= found else "partly"


def statuses(run: Run) -> dict[str, int]:
    """How many samples have each status."""
    return dict(Counter(record.status for record in run.records.values()))


@dataclass(frozen=True)
class Mean:
    """The mean of a further measure over the `n` samples where it is defined, with its 95 % bootstrap interval."""

    value: float
    low: float
    high: float
    n: int

    @classmethod
    def of(cls, values: np.ndarray) -> Mean:
        return cls(float(values.mean()), *_interval_of_mean(values), len(values))


def measures(run: Run) -> dict[str, Mean]:
    """The means of the records' further measures by name: "contact" hits, and what the benchmark adds."""
    found: dict[str, Mean] = {}
    for name in dict.fromkeys(name for record in run.records.values() for name in record.measures):
        values = np.sort([v for r in run.records.values() if (v := r.measures.get(name)) is not None])
        if len(values):
            found[name] = Mean.of(values)
    return found


def measure_changes(first: Run, second: Run) -> dict[str, tuple[Mean, Mean, Difference]]:
    """Each measure in both runs and its change with a paired 95 % interval, on the samples where both define it."""
    found: dict[str, tuple[Mean, Mean, Difference]] = {}
    for name in measures(first):
        pairs = [
            (a, b)
            for id, record in sorted(first.records.items())
            if id in second.records
            and (a := record.measures.get(name)) is not None
            and (b := second.records[id].measures.get(name)) is not None
        ]
        if pairs:
            one, two = np.array(pairs).T
            change = Difference(float((two - one).mean()), *_interval_of_mean(two - one))
            found[name] = Mean.of(one), Mean.of(two), change
    return found


def measure_name(name: str) -> str:
    """A measure's name for people."""
    return {"contact": "contact hits", "kld": "KLD", "sim": "SIM", "nss": "NSS"}.get(name, name)


def _interval_of_mean(values: np.ndarray) -> tuple[float, float]:
    draws = np.random.default_rng(0).integers(0, len(values), (metrics.RESAMPLES, len(values)))
    return metrics.interval(values[draws].mean(axis=1))


def errors(run: Run) -> Counter[str]:
    """How many samples failed for each reason, which is the message up to its first colon."""
    return Counter(record.row["error"].partition(":")[0] for record in run.records.values() if record.row["error"])


def summary(run: Run, accept: float | None = None) -> dict[str, Any]:
    """Scores and costs, ready for `json.dumps`: what scores.json and `--json` hold."""
    return {
        "run": str(run.folder),
        "benchmark": run.manifest.identity["benchmark"],
        "label": run.manifest.label,
        "planned": run.planned,
        "complete": run.complete,
        "scores": score(run).to_dict(),
        "statuses": statuses(run),
        "measures": {name: asdict(mean) for name, mean in measures(run).items()},
        "trust": found.to_dict() if (found := trust.trust(run, accept)) else None,
        "leaks": run.manifest.leaks,
        "groups": {
            name: {value: group.to_dict() for value, group in groups.items()} for name, groups in by_group(run).items()
        },
    }


def save(run: Run) -> Mapping[str, Any]:
    """Write scores.json into the run folder; returns what it holds."""
    found = summary(run)
    write_atomically(run.folder / "scores.json", (json.dumps(found, indent=1) + "\n").encode())
    return found
