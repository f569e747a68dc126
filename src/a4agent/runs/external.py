"""Masks that another system wrote, scored like our own: what `a4 score` does, from Python.

outcomes = list(score_predictions(load("umd", "data/umd"), Predictions("their/masks")))
metrics.score([outcome.row for outcome in outcomes], "strict")

`write_run` keeps them as a run folder, so that report, compare and tables can show that system too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from a4agent import metrics
from a4agent.benchmarks.base import Benchmark, Sample
from a4agent.benchmarks.predictions import Predictions
from a4agent.engine.pipeline import ordered_map
from a4agent.errors import DataError, InputError
from a4agent.imaging.load import load_image
from a4agent.metrics import Row
from a4agent.runs.bench import Selection, data_about, data_identity, row_of
from a4agent.runs.manifest import Manifest
from a4agent.runs.store import Run, RunWriter, read_run
from a4agent.types import Affordance, Region

MISSING = "no prediction"
LARGEST_FACTOR = 4.0
"""How many times a mask's sides may differ from the truth's before `resize` is required."""


@dataclass(frozen=True)
class ScoredSample:
    """One sample: its row, and why it failed (`MISSING`, or the reader's message; "" if it did not)."""

    id: str
    category: str
    row: Row
    problem: str = ""


def score_predictions(
    benchmark: Benchmark, predictions: Predictions, workers: int | None = None, *, resize: bool = False
) -> Iterator[ScoredSample]:
    """The outcome of every sample, in order; a missing or unreadable prediction is a failed sample.

    At most `workers` masks (None: one per core) are in memory at a time.

    Raises:
        DataError: the truth of a sample cannot be read (`a4 data check` lists all such), or, without `resize`, a
            prediction's size differs from the truth's by more than `LARGEST_FACTOR`.
    """

    def outcome(sample: Sample) -> ScoredSample:
        truths = sample.truth.masks()
        mask, problem = _predicted(sample, predictions, truths[0].shape, resize)
        return ScoredSample(sample.id, sample.truth.category or "none", metrics.measure_best(mask, truths)[0], problem)

    return ordered_map(outcome, benchmark, workers)


def write_run(
    benchmark: Benchmark,
    predictions: Predictions,
    folder: Path,
    *,
    name: str,
    protocol: str | None = None,
    leaks: Mapping[str, str] | None = None,
    resize: bool = False,
    progress: Callable[[], None] = lambda: None,
) -> Run:
    """Keep the predictions of the system `name` as a run in `folder`, with pictures; continues a run that was stopped.

    `leaks` are the answers to `manifest.LEAKS`; `progress` is called after every sample.

    Raises:
        ConfigError: the folder belongs to another configuration, or to other predictions.
        DataError: it is in use or holds other files, or what `score_predictions` raises.
    """
    manifest = Manifest(
        identity={
            **data_identity(benchmark, Selection(), protocol),
            "oracle": None,
            "settings": None,
            "experts": [{"id": f"external:{name}"}],
            "prompts": {},
            "predictions": predictions.digest(),
        },
        about={"label": name, **data_about(benchmark), "leaks": dict(leaks or {})},
    )

    def answered(sample: Sample) -> tuple[Sample, tuple[np.ndarray, ...], Affordance]:
        truths = sample.truth.masks()
        mask, problem = _predicted(sample, predictions, truths[0].shape, resize)
        return sample, truths, _answer(sample, mask, problem)

    with RunWriter(folder, manifest) as writer:
        for sample, truths, answer in ordered_map(answered, (s for s in benchmark if writer.wants(s.id))):
            writer.add(row_of(benchmark, sample, answer, truths, writer))
            progress()
    return read_run(folder)


def outcomes_of(run: Run) -> Iterable[ScoredSample]:
    """The outcomes that `write_run` kept."""
    for record in run.records.values():
        yield ScoredSample(record.id, record.category or "none", record.scored, record.row["error"] or "")


def _answer(sample: Sample, mask: np.ndarray | None, problem: str) -> Affordance:
    """The prediction as an affordance: one region without box or points, in the prediction's own size."""
    try:
        image = load_image(sample.query.image)
    except InputError:  # the other system may still have read it
        image = None
    instruction = sample.query.instruction
    if mask is None:
        return Affordance(instruction, image.size if image else (0, 0), status="error", error=problem, image=image)
    return Affordance(
        instruction,
        (mask.shape[1], mask.shape[0]),
        regions=(Region(None, np.zeros((0, 2), np.float32), mask),),
        status="ok" if mask.any() else "empty",
        image=image,
    )


def _predicted(
    sample: Sample, predictions: Predictions, shape: tuple[int, ...], resize: bool
) -> tuple[np.ndarray | None, str]:
    """The predicted mask of a sample, or None and the reason."""
    try:
        mask = predictions.mask(sample.id)
    except DataError as error:
        return None, str(error)
    if mask is None:
        return None, MISSING
    (high, wide), (height, width) = mask.shape, shape
    if not resize and max(high / height, height / max(high, 1), wide / width, width / max(wide, 1)) > LARGEST_FACTOR:
        raise DataError(
            f"the prediction for {sample.id!r} is {wide} x {high} and its truth {width} x {height}: they differ by more"
            f" than {LARGEST_FACTOR:g} times; pass --resize to stretch such masks"
        )
    return mask, ""
