"""gIoU, cIoU, P@50 and P@50:95 over rows of integers, under the protocols that the field has published.

    rows = [Row(98289, 102908), Row(0, 8571), Row(0, 640, status="error")]
    scores = score(rows)                      # or plain pairs: score([(98289, 102908), (0, 8571)])
    scores.giou, scores.ciou, scores.p50, scores.p50_95, scores.intervals["giou"]

A row is one sample: the pixels shared by prediction and truth (I) and covered by either (U), counted in
the truth's pixels. gIoU is the mean of I / U (not the box metric of the same name), cIoU is sum of I over
sum of U, P@t the share of samples with I / U above t, P@50:95 the mean of ten of them. Thresholds are
compared as integers, 100 * I > t * U, so that an exact tie falls the same way on every machine.

Protocols are data (`PROTOCOLS`): `strict` is ours, the others do what the peers' published code does.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from a4agent.errors import DataError, UnknownNameError
from a4agent.imaging.masks import deepest_point
from a4agent.types import Status, finite_or_none

MEASURES = {"giou": "gIoU", "ciou": "cIoU", "p50": "P@50", "p50_95": "P@50:95"}
"""The measures of a `Scores`, and how people write them."""

THRESHOLDS = np.arange(50, 100, 5)  # percent
RESAMPLES = 2000
CONTACT_SIDE = 480
"""Masks are searched for their contact point at about this many pixels a side."""


class Row(NamedTuple):
    """One scored sample. `intersection` and `union` are pixels; for a failed sample they are 0 and the truth's area.

    `status` is the affordance's: "invalid" (a model's answer could not be read) and "error" (it failed
    otherwise) are failures. Pixel counts tell whether a mask was blank; None is unknown.
    `resized` marks a prediction of another size than the truth.
    """

    intersection: int
    union: int
    status: Status = "ok"
    truth_pixels: int | None = None
    prediction_pixels: int | None = None
    resized: bool = False

    @property
    def failed(self) -> bool:
        return self.status in ("invalid", "error")


@dataclass(frozen=True)
class Protocol:
    """How failed and empty samples enter a score.

    `both_empty` is the IoU where U = 0 (None: the sample is dropped); `drops_errors` leaves out samples
    that failed other than by an unreadable answer, all other failures count as IoU 0 with U = the truth's
    area; the epsilons are added to the denominators; `thresholds` is False where P@t is not defined.
    """

    name: str
    summary: str
    both_empty: float | None = 1.0
    drops_errors: bool = False
    iou_epsilon: float = 0.0
    ciou_epsilon: float = 0.0
    thresholds: bool = True


PROTOCOLS = {
    protocol.name: protocol
    for protocol in (
        Protocol("strict", "every sample counts, a failed one as 0; both empty is 1"),
        # `return 0` is unpacked as a pair there, so both-empty samples end in the handler that skips a sample.
        Protocol(
            "affordance-r1", "Affordance-R1 on ReasonAff (d040e27): drops both-empty and failed samples", None, True
        ),
        # It stops at the first failed sample; none is in its published scores, here they count as 0.
        Protocol("affordance-r1-umd", "Affordance-R1 on UMD (d040e27): both empty is 1"),
        Protocol(
            "ragnet",
            "AffordanceNet on RAGNet, from LISA (bf5a171): small terms in the denominators, no P@t",
            iou_epsilon=1e-5,
            ciou_epsilon=1e-10,
            thresholds=False,
        ),
    )
}


@dataclass(frozen=True)
class Scores:
    """Scores from 0 to 1, NaN where nothing was scored or the protocol does not define them.

    `n` samples were given, `n_scored` of them entered the means, `n_failed` were invalid or errors,
    `n_empty_truth` and `n_empty_prediction` had a blank mask, `n_resized` a prediction of another size.
    `intervals` holds (low, high) of each measure, 95 % by bootstrap over the samples.
    """

    protocol: str
    giou: float
    ciou: float
    p50: float
    p50_95: float
    n: int
    n_scored: int
    n_failed: int
    n_empty_truth: int
    n_empty_prediction: int
    n_resized: int
    intervals: dict[str, tuple[float, float]]

    def to_dict(self) -> dict[str, Any]:
        """Ready for `json.dumps`: NaN as None."""
        values = asdict(self)
        values["intervals"] = {name: [finite_or_none(end) for end in ends] for name, ends in self.intervals.items()}
        return values | {name: finite_or_none(values[name]) for name in MEASURES}


@dataclass(frozen=True)
class Difference:
    """`second` run minus the `first` on the samples both have: the value and its 95 % interval, paired."""

    value: float
    low: float
    high: float

    @property
    def clear(self) -> bool:
        """The interval excludes 0."""
        return self.low > 0 or self.high < 0

    def to_dict(self) -> dict[str, float | None]:
        """Ready for `json.dumps`: NaN as None."""
        return {name: finite_or_none(value) for name, value in asdict(self).items()}


@dataclass(frozen=True)
class Comparison:
    """Two runs on the samples they share. `gained` and `lost` are the ids whose IoU crossed 0.5 up and down."""

    first: Scores
    second: Scores
    differences: dict[str, Difference]
    n_shared: int
    n_only_first: int
    n_only_second: int
    gained: tuple[str, ...]
    lost: tuple[str, ...]


def intersection_union(prediction_mask: np.ndarray, truth_mask: np.ndarray) -> tuple[int, int]:
    """Pixels in both masks and in either, counted in the truth's pixels. Masks are (H, W), foreground is non-zero.

    A prediction of another size is resized to the truth's by nearest neighbours.
    """
    row = measure(prediction_mask, truth_mask)
    return row.intersection, row.union


def measure(
    prediction_mask: np.ndarray | None,
    truth_mask: np.ndarray,
    status: Status = "ok",
    alternatives: Sequence[np.ndarray] = (),
) -> Row:
    """The row of one sample. No prediction, or a failed status, gives I = 0 and U = the truth's area.

    `alternatives` are masks that are as right as `truth_mask`: the one with the best IoU counts.

    Raises:
        DataError: a mask is not (H, W).
    """
    return measure_best(prediction_mask, (truth_mask, *alternatives), status)[0]


def measure_best(
    prediction_mask: np.ndarray | None, truth_masks: Sequence[np.ndarray], status: Status = "ok"
) -> tuple[Row, int]:
    """The row of one sample against the best of its equally right masks, and that mask's position.

    Which mask is best depends on the prediction, so `truth_pixels` is None where there are several.

    Raises:
        DataError: a mask is not (H, W).
    """
    rows = [_measure(prediction_mask, mask, status) for mask in truth_masks]
    best = max(range(len(rows)), key=lambda i: rows[i].intersection / max(rows[i].union, 1))
    return (rows[best] if len(rows) == 1 else rows[best]._replace(truth_pixels=None)), best


def _measure(prediction_mask: np.ndarray | None, truth_mask: np.ndarray, status: Status) -> Row:
    truth = _binary(truth_mask, "truth")
    truth_pixels = int(np.count_nonzero(truth))
    if prediction_mask is None or status in ("invalid", "error"):
        failed: Status = status if status in ("invalid", "error") else "error"
        return Row(0, truth_pixels, failed, truth_pixels, None)
    prediction = _binary(prediction_mask, "predicted")
    resized = prediction.shape != truth.shape
    if resized:
        prediction = nearest_neighbour(prediction, truth.shape)
    prediction_pixels = int(np.count_nonzero(prediction))
    both = int(np.count_nonzero(prediction & truth))
    return Row(both, prediction_pixels + truth_pixels - both, status, truth_pixels, prediction_pixels, resized)


def contact_hit(prediction_mask: np.ndarray | None, truth_masks: Sequence[np.ndarray]) -> float | None:
    """1 if the prediction's contact point lies in one of the right masks, else 0; None if all of those are blank.

    The contact point is the centre of the pixel farthest from the mask's border: where a robot would touch. Large masks
    are searched at every few pixels. A missing or blank prediction is a miss.
    """
    if not any(mask.any() for mask in truth_masks):
        return None
    if prediction_mask is None:
        return 0.0
    step = max(1, max(prediction_mask.shape) // CONTACT_SIDE)
    coarse = prediction_mask[step // 2 :: step, step // 2 :: step]
    point = deepest_point(coarse)
    if point is None and step > 1:  # too thin to be seen from afar
        step, coarse, point = 1, prediction_mask, deepest_point(prediction_mask)
    if point is None:
        return 0.0
    column, row = (np.floor(point) * step + step // 2 + 0.5) / prediction_mask.shape[::-1]
    return float(any(mask[int(row * mask.shape[0]), int(column * mask.shape[1])] for mask in truth_masks))


def nearest_neighbour(mask: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The mask (H, W) in another `shape` (h, w): each new pixel takes the value under its centre, in integers."""
    if not mask.size:
        return np.zeros(shape, mask.dtype)
    height, width = shape
    rows = (2 * np.arange(height) + 1) * mask.shape[0] // (2 * height)
    columns = (2 * np.arange(width) + 1) * mask.shape[1] // (2 * width)
    return mask[rows[:, None], columns]


def protocol_of(name: str) -> Protocol:
    """The protocol of that name.

    Raises:
        UnknownNameError: no such protocol; the message suggests the nearest.
    """
    if name not in PROTOCOLS:
        raise UnknownNameError.of("protocol", name, PROTOCOLS)
    return PROTOCOLS[name]


def score(
    intersection_union: Iterable[Row | Sequence[int]],
    protocol: str = "strict",
    *,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Scores:
    """Score rows: `Row`s, or plain pairs (I, U). Neither scores nor intervals depend on the order of the rows.

    The intervals repeat for the same `seed`; `resamples=0` leaves them out (running scores).

    Raises:
        UnknownNameError: no such protocol.
        DataError: a row whose counts are impossible, such as I > U.
    """
    rule = protocol_of(protocol)
    rows = [row if isinstance(row, Row) else Row(int(row[0]), int(row[1])) for row in intersection_union]
    table, kept = _table(rows, rule)
    table = table[:, kept]
    return _scores(rule, rows, table, _intervals(_measures(_resample(table, resamples, seed), len(table[0]), rule)))


def iou(row: Row, protocol: str = "strict") -> float | None:
    """One sample's IoU as the protocol counts it; None if it drops the sample."""
    table, kept = _table([row], protocol_of(protocol))
    return float(table[0, 0]) if kept[0] else None


def score_by(
    rows: Iterable[Row], groups: Iterable[str], protocol: str = "strict", *, resamples: int = RESAMPLES
) -> dict[str, Scores]:
    """The scores of each group (a category, a status): `groups` names one for every row, in the same order."""
    members: dict[str, list[Row]] = {}
    for row, group in zip(rows, groups, strict=True):
        members.setdefault(group, []).append(row)
    return {group: score(its_rows, protocol, resamples=resamples) for group, its_rows in members.items()}


def compare(
    first: Mapping[str, Row],
    second: Mapping[str, Row],
    protocol: str = "strict",
    *,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Comparison:
    """Two runs, as rows by sample id: paired on the samples that both have and that the protocol keeps in both.

    Raises:
        DataError: they share no sample, or a sample was scored against two different truths.
    """
    rule = protocol_of(protocol)
    shared = [name for name in first if name in second]
    if not shared:
        raise DataError("the two runs share no sample: they are of different benchmarks or different selections of one")
    for name in shared:
        _same_truth(name, first[name], second[name])
    tables = [_table([run[name] for name in shared], rule) for run in (first, second)]
    kept = tables[0][1] & tables[1][1]
    names = [name for name, keep in zip(shared, kept, strict=True) if keep]
    pair = [table[:, kept] for table, _ in tables]
    draws = np.split(_resample(np.concatenate(pair), resamples, seed), 2, axis=1)
    measures = [_measures(sums, len(names), rule) for sums in draws]
    scores = [
        _scores(rule, [run[name] for name in shared], table, _intervals(drawn))
        for run, table, drawn in zip((first, second), pair, measures, strict=True)
    ]
    differences = _intervals(measures[1] - measures[0])
    crossed = pair[1][1] - pair[0][1]
    return Comparison(
        first=scores[0],
        second=scores[1],
        differences={
            name: Difference(getattr(scores[1], name) - getattr(scores[0], name), *differences[name])
            for name in MEASURES
        },
        n_shared=len(shared),
        n_only_first=len(first) - len(shared),
        n_only_second=len(second) - len(shared),
        gained=tuple(name for name, change in zip(names, crossed, strict=True) if change > 0),
        lost=tuple(name for name, change in zip(names, crossed, strict=True) if change < 0),
    )


def _table(rows: Sequence[Row], rule: Protocol) -> tuple[np.ndarray, np.ndarray]:
    """Each sample's part of the sums, (lines, n) float64: IoU, whether above 0.5, thresholds passed, I, U.

    The second value (n,) of bool says which samples the protocol keeps.
    """
    counts = np.array([(row.intersection, row.union) for row in rows], np.int64).reshape(-1, 2)
    shared, either = counts[:, 0], counts[:, 1]
    impossible = np.flatnonzero((shared < 0) | (shared > either))
    if len(impossible):
        raise DataError(f"row {impossible[0]} cannot be: I and U are {rows[impossible[0]][:2]}, but 0 <= I <= U")
    failed = np.array([row.failed for row in rows], bool)
    blank = (either == 0) & ~failed
    both_empty = rule.both_empty or 0.0
    ious = np.where(blank, both_empty, shared / np.maximum(either + rule.iou_epsilon, 1e-300))
    passed = 100 * shared > THRESHOLDS[:, None] * either
    passed = np.where(blank, 100 * both_empty > THRESHOLDS[:, None], passed)
    kept = ~blank if rule.both_empty is None else np.ones(len(rows), bool)
    if rule.drops_errors:
        kept &= np.array([row.status != "error" for row in rows], bool)
    return np.stack([ious, passed[0], passed.sum(0), shared, either]).astype(np.float64), kept


def _measures(sums: np.ndarray, n: int, rule: Protocol) -> np.ndarray:
    """From sums over n samples of a table's lines, (k, lines), to the values of `MEASURES`, (k, measures)."""
    iou, above_half, passed, shared, either = sums.T
    with np.errstate(invalid="ignore", divide="ignore"):
        measures = np.stack(
            [iou / n, shared / (either + rule.ciou_epsilon), above_half / n, passed / (n * len(THRESHOLDS))], axis=1
        )
    if not rule.thresholds:
        measures[:, 2:] = np.nan
    return measures


def _scores(
    rule: Protocol, rows: Sequence[Row], table: np.ndarray, intervals: dict[str, tuple[float, float]]
) -> Scores:
    n = table.shape[1]
    # math.fsum is exact, so a run that was resumed in another order has the same scores to the last bit.
    sums = np.array([[math.fsum(line) for line in table]])
    values = _measures(sums, n, rule)[0].tolist() if n else [math.nan] * len(MEASURES)
    return Scores(
        protocol=rule.name,
        **dict(zip(MEASURES, values, strict=True)),
        n=len(rows),
        n_scored=n,
        n_failed=sum(row.failed for row in rows),
        n_empty_truth=sum(row.union == 0 if row.truth_pixels is None else row.truth_pixels == 0 for row in rows),
        n_empty_prediction=sum(_blank_prediction(row) for row in rows),
        n_resized=sum(row.resized for row in rows),
        intervals=intervals,
    )


def _resample(table: np.ndarray, resamples: int, seed: int) -> np.ndarray:
    """Sums of a table's lines over samples drawn with replacement, (resamples, lines)."""
    lines, n = table.shape
    if not n or not resamples:
        return np.empty((0, lines))
    table = np.ascontiguousarray(table[:, np.lexsort(table)])
    generator = np.random.default_rng(seed)
    return np.stack([table[:, generator.integers(0, n, n)].sum(axis=1) for _ in range(resamples)])


def interval(values: np.ndarray) -> tuple[float, float]:
    """The middle 95 % of the values (k,) that are not NaN; NaN without any."""
    defined = values[~np.isnan(values)]
    low, high = np.percentile(defined, [2.5, 97.5]).tolist() if len(defined) else (math.nan, math.nan)
    return low, high


def _intervals(measures: np.ndarray) -> dict[str, tuple[float, float]]:
    """The interval of each measure over resamples (k, measures)."""
    return {name: interval(values) for name, values in zip(MEASURES, measures.T, strict=True)}


def _blank_prediction(row: Row) -> bool:
    if row.prediction_pixels is not None:
        return row.prediction_pixels == 0
    return not row.failed and (row.union == 0 or row.status == "empty")


def _same_truth(name: str, first: Row, second: Row) -> None:
    areas = first.truth_pixels, second.truth_pixels
    if None not in areas and areas[0] != areas[1]:
        raise DataError(
            f"the truth of sample {name!r} has {areas[0]} pixels in one run and {areas[1]} in the other: "
            "they were scored against different data or under different rules, so they cannot be compared"
        )


def _binary(mask: np.ndarray, which: str) -> np.ndarray:
    if mask.ndim != 2:
        raise DataError(f"a {which} mask is (H, W), not of shape {mask.shape}")
    return mask if mask.dtype == np.bool_ else mask != 0
