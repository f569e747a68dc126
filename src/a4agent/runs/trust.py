"""Does the confidence tell right answers from wrong ones? Figures from a run's confidences and IoUs alone.

    auroc(np.array([0.9, 0.8, 0.3]), np.array([True, False, False]))      # 1.0

An answer is right if its IoU is at least 0.5. Ties are averaged, so no figure depends on the order of the samples. AURC
and the risk-coverage curve are those of Geifman and El-Yaniv (arXiv 1805.08206), the expected calibration error that of
Guo et al. (arXiv 1706.04599) with ten bins of equal width.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from a4agent.metrics import Difference, interval
from a4agent.runs.store import Record, Run
from a4agent.types import finite_or_none

MEASURES = {
    "auroc": "AUROC",
    "aurc": "AURC",
    "ece": "ECE",
    "brier": "Brier",
    "coverage": "coverage",
    "accepted_giou": "gIoU, accepted",
    "accepted_right": "P@50, accepted",
}
"""The figures of a `Trust` and their names for people. Lower is better for AURC, ECE and Brier."""

BINS = 10
RESAMPLES = 1000


@dataclass(frozen=True)
class Bin:
    """Answers whose confidence is in [low, high): how many, their mean confidence and the share that is right."""

    low: float
    high: float
    n: int
    confidence: float
    right: float


@dataclass(frozen=True)
class Trust:
    """Of `n` answers `n_rated` have a confidence and `n_abstained` were not accepted.

    `values` are the figures of `MEASURES` from 0 to 1, NaN where undefined: AUROC, AURC, ECE and Brier of the rated
    answers, `coverage` the share of all answers that was accepted. `curve` holds (coverage, risk): the share of wrong
    answers among the most confident.
    """

    n: int
    n_rated: int
    n_abstained: int
    accept: float | None
    values: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    curve: tuple[tuple[float, float], ...]
    bins: tuple[Bin, ...]

    def to_dict(self) -> dict[str, Any]:
        """Ready for `json.dumps`: NaN as None."""
        return {
            "n": self.n,
            "rated": self.n_rated,
            "abstained": self.n_abstained,
            "accept": self.accept,
            **{name: finite_or_none(value) for name, value in self.values.items()},
            "intervals": {name: list(map(finite_or_none, ends)) for name, ends in self.intervals.items()},
            "curve": [list(point) for point in self.curve],
            "bins": [{name: finite_or_none(value) for name, value in vars(one).items()} for one in self.bins],
        }


def with_accept(run: Run, accept: float) -> Run:
    """The same run with its answers accepted or abstained at another threshold, without asking any model.

    The answers stay as they are, although a run made with that threshold might have retried other samples.
    """
    records: dict[str, Record] = {}
    for id, record in run.records.items():
        if record.status in ("ok", "abstained") and record.confidence is not None:
            status = "ok" if record.confidence >= accept else "abstained"
            record = Record({**record.row, "status": status})
        records[id] = record
    return replace(run, records=records)


def accept_of(run: Run) -> float | None:
    """The threshold of the run's own settings; None without a Verifier."""
    settings: Mapping[str, Any] = run.manifest.identity.get("settings") or {}
    return (settings.get("verifier") or {}).get("accept")


def trust(run: Run, accept: float | None = None, *, resamples: int = RESAMPLES, seed: int = 0) -> Trust | None:
    """How far a run's confidences can be trusted, with 95 % bootstrap intervals; None if it has no confidence.

    `accept` is the threshold to name; the answers accepted are those whose status is "ok" (see `with_accept`).
    """
    table = _table(run.records.values())
    rated, confidence, iou = table[0].astype(bool), table[1], table[2]
    if not rated.any():
        return None
    known, wrong = confidence[rated], iou[rated] < 0.5
    draws = np.random.default_rng(seed).integers(0, len(iou), (resamples, len(iou)))
    return Trust(
        n=len(iou),
        n_rated=int(rated.sum()),
        n_abstained=sum(record.status == "abstained" for record in run.records.values()),
        accept=accept_of(run) if accept is None else accept,
        values=dict(zip(MEASURES, _figures(table), strict=True)),
        intervals=_intervals(np.array([_figures(table[:, draw]) for draw in draws])),
        curve=tuple(_thinned(risk_coverage(known, wrong))),
        bins=tuple(reliability(known, ~wrong)),
    )


def compare(
    first: Run, second: Run, *, resamples: int = RESAMPLES, seed: int = 0
) -> dict[str, tuple[tuple[float, float], Difference]] | None:
    """Both runs' figures and `second` minus `first` with its paired 95 % interval, on the samples both have.

    None unless both have confidences.
    """
    shared = sorted(id for id in first.records if id in second.records)
    tables = [_table(run.records[id] for id in shared) for run in (first, second)]
    if not all(table[0].any() for table in tables):
        return None
    values = [_figures(table) for table in tables]
    draws = np.random.default_rng(seed).integers(0, len(shared), (resamples, len(shared)))
    changes = np.array([np.subtract(_figures(tables[1][:, d]), _figures(tables[0][:, d])) for d in draws])
    ends = _intervals(changes)
    return {
        name: ((one, two), Difference(two - one, *ends[name]))
        for name, one, two in zip(MEASURES, *values, strict=True)
        if one == one and two == two
    }


def auroc(confidence: np.ndarray, right: np.ndarray) -> float:
    """How likely a right answer (n,) has more confidence (n,) than a wrong one; ties count half. NaN for one kind."""
    n_right, n_wrong = int(right.sum()), int((~right).sum())
    if not n_right or not n_wrong:
        return math.nan
    _, place, counts = np.unique(confidence, return_inverse=True, return_counts=True)
    ranks = np.cumsum(counts) - (counts - 1) / 2
    return float((ranks[place][right].sum() - n_right * (n_right + 1) / 2) / (n_right * n_wrong))


def risk_coverage(confidence: np.ndarray, wrong: np.ndarray) -> np.ndarray:
    """(n, 2): the share k / n of answers kept, most confident first, and the share of them that is `wrong` (n,) bool.

    Each of several answers with one confidence counts with their mean risk.
    """
    values, place, counts = np.unique(-confidence, return_inverse=True, return_counts=True)
    means = np.bincount(place, wrong.astype(np.float64), len(values)) / counts
    kept = np.arange(1, len(wrong) + 1)
    return np.stack([kept / len(wrong), np.cumsum(np.repeat(means, counts)) / kept], axis=1)


def aurc(confidence: np.ndarray, wrong: np.ndarray) -> float:
    """The mean risk over all coverages; lower is better. NaN without answers."""
    return float(risk_coverage(confidence, wrong)[:, 1].mean()) if len(wrong) else math.nan


def reliability(confidence: np.ndarray, right: np.ndarray, bins: int = BINS) -> list[Bin]:
    """The answers by confidence, in bins of equal width; 1.0 belongs to the last."""
    place = np.minimum((confidence * bins).astype(int), bins - 1)
    found: list[Bin] = []
    for i in range(bins):
        inside = place == i
        n = int(inside.sum())
        means = (float(confidence[inside].mean()), float(right[inside].mean())) if n else (math.nan, math.nan)
        found.append(Bin(i / bins, (i + 1) / bins, n, *means))
    return found


def ece(confidence: np.ndarray, right: np.ndarray, bins: int = BINS) -> float:
    """The expected calibration error: the mean gap of the bins' confidence and share right. NaN without answers."""
    if not len(right):
        return math.nan
    place = np.minimum((confidence * bins).astype(int), bins - 1)
    return float(np.abs(np.bincount(place, confidence - right, bins)).sum() / len(right))


def _table(records: Iterable[Record]) -> np.ndarray:
    """(4, n): whether the answer has a confidence, that confidence (0 without), IoU, accepted."""
    rows = [(r.confidence is not None, r.confidence or 0.0, r.iou, r.status == "ok") for r in records]
    return np.array(rows, np.float64).reshape(-1, 4).T


def _figures(table: np.ndarray) -> list[float]:
    """The figures of `MEASURES`, in order."""
    rated, accepted = table[0].astype(bool), table[3].astype(bool)
    confidence, iou = table[1][rated], table[2]
    right = iou[rated] >= 0.5
    kept = iou[accepted]
    return [
        auroc(confidence, right),
        aurc(confidence, ~right),
        ece(confidence, right),
        float(np.square(confidence - right).mean()) if len(right) else math.nan,
        float(accepted.mean()) if len(iou) else math.nan,
        float(kept.mean()) if len(kept) else math.nan,
        float((kept >= 0.5).mean()) if len(kept) else math.nan,
    ]


def _intervals(draws: np.ndarray) -> dict[str, tuple[float, float]]:
    """The middle 95 % of each figure over draws (k, figures)."""
    return {name: interval(values) for name, values in zip(MEASURES, draws.T, strict=True)}


def _thinned(curve: np.ndarray, most: int = 200) -> Sequence[tuple[float, float]]:
    """At most so many points of a curve for drawing, including its ends."""
    places = np.unique(np.linspace(0, len(curve) - 1, min(most, len(curve))).round().astype(int))
    return [(round(float(x), 6), round(float(y), 6)) for x, y in curve[places]]
