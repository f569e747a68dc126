"""Turn the boxes and points of a detector into prompts for a segmenter: clean them and pair them.

Boxes are (n, 4) xyxy, points (m, 2) xy, in pixels. Pure array functions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Literal

import numpy as np

from a4agent.protocols import Prompt
from a4agent.types import Detection, no_points

Pairing = Literal["optimal", "paper", "inside"]
Pair = tuple[int | None, list[int]]
"""One region: the index of its box or None, and the indices of its points."""


def to_prompts(detection: Detection, size_wh: tuple[int, int], pairing: Pairing) -> list[tuple[Prompt, int | None]]:
    """One prompt for each region to segment, with the index of its box in the detection.

    "paper" pairs by index what the model gave and cleans the pairs afterwards, as the authors do; the others clean
    first. Points that were derived from the boxes are not used.
    """
    boxes, box_numbers = clean_boxes(detection.boxes_xyxy, size_wh)
    points, point_numbers = clean_points(detection.points_xy, size_wh)
    if detection.points_derived:
        points, pairs = no_points(), _all_boxes(len(boxes), lambda _: [])
    elif pairing == "paper":
        box_at = {int(number): i for i, number in enumerate(box_numbers)}
        point_at = {int(number): j for j, number in enumerate(point_numbers)}
        raw = pair_as_paper(np.size(detection.boxes_xyxy) // 4, np.size(detection.points_xy) // 2)
        cleaned = [(None if i is None else box_at.get(i), [point_at[j] for j in js if j in point_at]) for i, js in raw]
        pairs = [(i, js) for i, js in cleaned if i is not None or js]
    elif pairing == "inside":
        pairs = pair_by_holder(boxes, points)
    else:
        pairs = pair_optimally(boxes, points)
    return [
        (
            Prompt(None if i is None else boxes[i], points[js].reshape(-1, 2)),
            None if i is None else int(box_numbers[i]),
        )
        for i, js in pairs
    ]


def clean_boxes(boxes_xyxy: np.ndarray, size_wh: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Order the corners, clip to the image, drop boxes without area and those with a coordinate that is not finite.

    Returns the boxes (k, 4) float32 and their indices (k,) in the input.
    """
    boxes = np.asarray(boxes_xyxy, np.float64).reshape(-1, 4)
    finite = np.all(np.isfinite(boxes), axis=1)
    boxes = np.where(finite[:, None], boxes, 0.0)
    low = np.minimum(boxes[:, :2], boxes[:, 2:])
    high = np.maximum(boxes[:, :2], boxes[:, 2:])
    edge = np.array(size_wh, np.float64)
    ordered = np.concatenate([np.clip(low, 0, edge), np.clip(high, 0, edge)], 1).astype(np.float32)
    kept = np.flatnonzero(finite & (ordered[:, 2] > ordered[:, 0]) & (ordered[:, 3] > ordered[:, 1]))
    return ordered[kept], kept


def clean_points(points_xy: np.ndarray, size_wh: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Drop points outside the image; one on its right or bottom edge is moved just inside.

    Returns the points (k, 2) float32 and their indices (k,) in the input.
    """
    points = np.asarray(points_xy, np.float64).reshape(-1, 2)
    edge = np.array(size_wh, np.float64)
    kept = np.flatnonzero((points >= 0).all(1) & (points <= edge).all(1))  # nan is neither
    return np.minimum(points[kept], np.nextafter(edge.astype(np.float32), np.float32(0))).astype(np.float32), kept


def pair_as_paper(boxes: int, points: int) -> list[Pair]:
    """The authors' rule: the i-th box with the i-th point if there are as many, points alone otherwise."""
    if boxes == points:
        return _all_boxes(boxes, lambda i: [i])
    return _lone_points(range(points))


def pair_optimally(boxes_xyxy: np.ndarray, points_xy: np.ndarray) -> list[Pair]:
    """At most one point for each box, inside it: as many pairs as possible, and of those the least total distance.

    Distance is measured from the box's centre, in half-sides of the box. A box without a point stands alone. A point
    outside all boxes is a region of its own; a surplus point inside one is dropped.
    """
    boxes = np.asarray(boxes_xyxy, np.float64).reshape(-1, 4)
    points = np.asarray(points_xy, np.float64).reshape(-1, 2)
    if not len(boxes) or not len(points):
        return _all_boxes(len(boxes), lambda _: []) + _lone_points(range(len(points)))
    inside, distance = _from_centres(boxes, points)
    taken = _assign(inside, distance)
    loose = [int(j) for j in np.flatnonzero(~inside.any(0))]
    return _all_boxes(len(boxes), lambda i: [taken[i]] if i in taken else []) + _lone_points(loose)


def _assign(inside: np.ndarray, distance: np.ndarray) -> dict[int, int]:
    """The point of each box that gets one. Scipy takes half a second to import, so only contested points pay for it."""
    if inside.sum(0).max() <= 1 and inside.sum(1).max() <= 1:
        return {int(i): int(j) for i, j in np.argwhere(inside)}
    from scipy.optimize import linear_sum_assignment

    outside = 2.0 * (min(inside.shape) + 1)
    rows, columns = linear_sum_assignment(np.where(inside, distance, outside))
    return {int(i): int(j) for i, j in zip(rows, columns, strict=True) if inside[i, j]}


def pair_by_holder(boxes_xyxy: np.ndarray, points_xy: np.ndarray) -> list[Pair]:
    """Every point goes with the box that holds it, of several the one with the nearest centre; others stand alone.

    A single box takes all points, also those outside it. For models that mark one instance with a box and several
    points (Seg-Zero).
    """
    boxes = np.asarray(boxes_xyxy, np.float64).reshape(-1, 4)
    points = np.asarray(points_xy, np.float64).reshape(-1, 2)
    if not len(boxes):
        return _lone_points(range(len(points)))
    inside, distance = _from_centres(boxes, points)
    if len(boxes) == 1:
        inside[:] = True
    holder = np.where(inside, distance, np.inf).argmin(0)
    held = inside.any(0)
    return _all_boxes(len(boxes), lambda i: [int(j) for j in np.flatnonzero(held & (holder == i))]) + _lone_points(
        int(j) for j in np.flatnonzero(~held)
    )


def _from_centres(boxes: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of n boxes and m points (n, m): which holds which, and the distances from the centres in half-sides."""
    centre, half = (boxes[:, :2] + boxes[:, 2:]) / 2, (boxes[:, 2:] - boxes[:, :2]) / 2
    offset = np.abs(points[None] - centre[:, None]) / np.maximum(half[:, None], 1e-9)
    inside = np.all((points[None] >= boxes[:, None, :2]) & (points[None] <= boxes[:, None, 2:]), axis=2)
    return inside, np.sqrt((offset**2).sum(2))


def _all_boxes(count: int, points_of: Callable[[int], list[int]]) -> list[Pair]:
    return [(i, points_of(i)) for i in range(count)]


def _lone_points(points: Iterable[int]) -> list[Pair]:
    return [(None, [j]) for j in points]
