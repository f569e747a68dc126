"""Masks that another system's own code wrote, scored like our own: what `a4 score` does, from Python.

outcomes = list(score_predictions(load("umd", "data/umd"), Predictions("their/masks")))
metrics.score([outcome.row for outcome in outcomes], "strict")

`write_run` keeps them as a run folder, so that report, compare and tables show that system beside ours.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from a4agent import metrics
from a4agent.benchmarks.base import Benchmark, Sample
from a4agent.benchmarks.predictions import Predictions
from a4agent.engine.pipeline import ordered_map
from a4agent.errors import DataError, InputError
from a4agent.imaging.load import load_image
from a4agent.metrics import Row, measure
from a4agent.runs.bench import row_of
from a4agent.runs.manifest import Manifest
from a4agent.runs.store import Run, RunWriter, read_run
from a4agent.types import Affordance, Region

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


def write_run(
    benchmark: Benchmark, predictions: Predictions, folder: Path, *, name: str, protocol: str | None = None
) -> Run:
    """Keep what the system `name` predicted as a run in `folder`, with pictures; goes on where it was stopped.

    Raises:
        ConfigError: the folder belongs to another configuration, or to other predictions.
        DataError: it is in use or holds other files, or the truth of a sample cannot be read.
    """
    manifest = Manifest(
        identity={
            "benchmark": benchmark.name,
            "data": benchmark.fingerprint(),
            "selection": {"limit": None, "shuffle": None, "samples": len(benchmark)},
            "protocol": metrics.protocol_of(protocol or benchmark.protocol).name,
            "oracle": None,
            "settings": None,
            "experts": [{"id": f"external:{name}"}],
            "prompts": {},
            "predictions": predictions.digest(),
        },
        about={"label": name, "data": str(benchmark.root), "licence": benchmark.licence},
    )
    with RunWriter(folder, manifest) as writer:
        wanted = (sample for sample in benchmark if writer.wants(sample.id))
        for sample, truths, answer in ordered_map(
            lambda one: (one, one.truth.masks(), _answer(one, predictions)), wanted
        ):
            writer.add(row_of(sample, answer, truths, writer))
    return read_run(folder)


def _outcome(sample: Sample, predictions: Predictions) -> Outcome:
    truth, *others = sample.truth.masks()
    prediction, problem = _predicted(sample, predictions)
    return Outcome(sample.id, sample.truth.category or "none", measure(prediction, truth, alternatives=others), problem)


def _answer(sample: Sample, predictions: Predictions) -> Affordance:
    """What was predicted as an answer of ours: one region without box or points, in the prediction's own size."""
    prediction, problem = _predicted(sample, predictions)
    try:
        image = load_image(sample.query.image)
    except InputError:  # the other system has read it, or else has failed
        image = None
    if prediction is None:
        error = "no prediction" if problem == MISSING else f"unreadable prediction: {problem}"
        return Affordance(
            sample.query.instruction, image.size if image else (0, 0), status="error", error=error, image=image
        )
    region = Region(None, np.zeros((0, 2), np.float32), prediction)
    return Affordance(
        sample.query.instruction,
        (prediction.shape[1], prediction.shape[0]),
        regions=(region,),
        status="ok" if prediction.any() else "empty",
        image=image,
    )


def _predicted(sample: Sample, predictions: Predictions) -> tuple[np.ndarray | None, str]:
    """The mask predicted for a sample, or None and why there is none."""
    try:
        mask = predictions.mask(sample.id)
    except DataError as error:
        return None, str(error)
    return mask, MISSING if mask is None else ""
