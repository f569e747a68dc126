"""What a run scored: as a whole, by category, and in words why a sample missed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from a4agent import metrics
from a4agent.metrics import Row, Scores
from a4agent.runs.store import Record, Run, write_atomically

OUTCOMES = ("hit", "too much", "too little", "partly", "elsewhere", "nothing found", "unreadable", "failed")
"""How a sample ended, best first; see `outcome`."""


def protocol_of(run: Run) -> str:
    """The protocol that the run was made for."""
    return str(run.manifest.identity["protocol"])


def rows_of(run: Run) -> dict[str, Row]:
    """What the metrics need, by sample id."""
    return {id: record.scored for id, record in run.records.items()}


def score(run: Run, protocol: str | None = None) -> Scores:
    """The scores of the samples that are there; by the run's own protocol unless another is named."""
    return metrics.score(rows_of(run).values(), protocol or protocol_of(run))


def by_category(run: Run, protocol: str | None = None) -> dict[str, Scores]:
    """The scores of each category, worst gIoU first; empty if the benchmark has none."""
    names = [record.category for record in run.records.values()]
    if not any(names):
        return {}
    found = metrics.score_by(rows_of(run).values(), names, protocol or protocol_of(run))
    return dict(sorted(found.items(), key=lambda item: (item[1].giou, item[0])))


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
    truth, found = row.truth_pixels or 0, row.prediction_pixels
    if 10 * row.intersection < row.union and 2 * row.intersection < max(truth, 1) and 2 * row.intersection < found:
        return "elsewhere"
    if 2 * row.intersection >= truth:
        return "too much"
    return "too little" if 2 * row.intersection >= found else "partly"


def summary(run: Run) -> dict[str, Any]:
    """Scores and costs, ready for `json.dumps`: what scores.json and `--json` hold."""
    return {
        "run": str(run.folder),
        "benchmark": run.manifest.identity["benchmark"],
        "label": run.manifest.label,
        "planned": run.planned,
        "complete": run.complete,
        "scores": score(run).to_dict(),
        "categories": {name: found.to_dict() for name, found in by_category(run).items()},
    }


def save(run: Run) -> Mapping[str, Any]:
    """Write scores.json into the run folder; returns what it holds."""
    found = summary(run)
    write_atomically(run.folder / "scores.json", (json.dumps(found, indent=1) + "\n").encode())
    return found
