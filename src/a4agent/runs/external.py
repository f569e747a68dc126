"""Masks that another system's own code wrote, scored like our own: what `a4 score` does, from Python.

outcomes = list(score_predictions(load("umd", "data/umd"), Predictions("their/masks")))
metrics.score([outcome.row for outcome in outcomes], "strict")
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from a4agent.benchmarks.base import Benchmark, Sample
from a4agent.benchmarks.predictions import Predictions
from a4agent.engine.threads import ordered_map
from a4agent.errors import DataError
from a4agent.metrics import Row, measure

MISSING = "missing"


@dataclass(frozen=True)
class Outcome:
    """One sample: its row, and why it failed (`MISSING`, or the reader's message; "" if it did not)."""

    id: str
    category: str
    row: Row
    problem: str = ""


def score_predictions(benchmark: Benchmark, predictions: Predictions, workers: int | None = None) -> Iterator[Outcome]:
    """The outcome of every sample, in order; a prediction that is missing or unreadable is a failed sample.

    Only as many masks as there are `workers` (None: one a core) are in memory at a time.

    Raises:
        DataError: the truth of a sample cannot be read; `a4 data check` lists all such.
    """
    return ordered_map(lambda sample: _outcome(sample, predictions), benchmark, workers)


def _outcome(sample: Sample, predictions: Predictions) -> Outcome:
    truth, others = sample.truth.mask(), sample.truth.alternatives()
    try:
        prediction, problem = predictions.mask(sample.id), MISSING
    except DataError as error:
        prediction, problem = None, str(error)
    row = measure(prediction, truth, alternatives=others)
    return Outcome(sample.id, sample.truth.category or "none", row, problem if prediction is None else "")
