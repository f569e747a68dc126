"""Boxes and points as models give them, made fit to prompt a segmenter with.

Boxes are (n, 4) xyxy, points (m, 2) xy, in pixels. Pure array functions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Literal

import numpy as np

from a4agent.protocols import Prompt

Pairing = Literal["optimal", "paper", "inside"]
Pair = tuple[int | None, list[int]]
"""One region: the index of its box or None, and the indices of its points."""


def clean_boxes(boxes_xyxy: np.ndarray, size_wh: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Order the corners, clip to the image, drop what is left without area or was not a number.

    Returns the boxes (k, 4) float32 and the indices (k,) they had.
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


def clean_points(points_xy: np.ndarray, size_wh: tuple[int, int]) -> np.ndarray:
    """The points (k, 2) float32 that lie in the image; one on its right or bottom edge is moved just inside."""
    points = np.asarray(points_xy, np.float64).reshape(-1, 2)
    edge = np.array(size_wh, np.float64)
    points = points[np.isfinite(points).all(1)]
    points = points[(points >= 0).all(1) & (points <= edge).all(1)]
    return np.minimum(points, np.nextafter(edge.astype(np.float32), np.float32(0))).astype(np.float32)


def pair(boxes_xyxy: np.ndarray, points_xy: np.ndarray, pairing: Pairing) -> list[Pair]:
    """Which points belong to which box."""
    if pairing == "paper":
        return pair_as_paper(len(boxes_xyxy), len(points_xy))
    if pairing == "inside":
        return pair_by_holder(boxes_xyxy, points_xy)
    return pair_optimally(boxes_xyxy, points_xy)


def pair_as_paper(boxes: int, points: int) -> list[Pair]:
    """The authors' rule: the i-th box with the i-th point if there are as many, points alone otherwise."""
    if boxes == points:
        return _all_boxes(boxes, lambda i: [i])
    return _lone_points(range(points))


def pair_optimally(boxes_xyxy: np.ndarray, points_xy: np.ndarray) -> list[Pair]:
    """One point to a box at most, inside it, with as many pairs as possible and then the least distance.

    Distance is from the box's centre, in half-sides of the box. A box without a point stands alone. A point
    that no box took and no box holds is a region of its own; one that lies in a box adds nothing and is left out.
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
    """The point of each box that gets one. Where nothing is contested, scipy's half second of import is saved."""
    if inside.sum(0).max() <= 1 and inside.sum(1).max() <= 1:
        return {int(i): int(j) for i, j in np.argwhere(inside)}
    from scipy.optimize import linear_sum_assignment

    outside = 2.0 * (min(inside.shape) + 1)
    rows, columns = linear_sum_assignment(np.where(inside, distance, outside))
    return {int(i): int(j) for i, j in zip(rows, columns, strict=True) if inside[i, j]}


def pair_by_holder(boxes_xyxy: np.ndarray, points_xy: np.ndarray) -> list[Pair]:
    """Every point goes with the box that holds it, of several the one with the nearest centre; others stand alone.

    For models that mark one instance with a box and several points (Seg-Zero).
    """
    boxes = np.asarray(boxes_xyxy, np.float64).reshape(-1, 4)
    points = np.asarray(points_xy, np.float64).reshape(-1, 2)
    if not len(boxes):
        return _lone_points(range(len(points)))
    inside, distance = _from_centres(boxes, points)
    holder = np.where(inside, distance, np.inf).argmin(0)
    held = inside.any(0)
    return _all_boxes(len(boxes), lambda i: [int(j) for j in np.flatnonzero(held & (holder == i))]) + _lone_points(
        int(j) for j in np.flatnonzero(~held)
    )


def _from_centres(boxes: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of n boxes and m points (n, m): which holds which, and the distances from the centres in half-sides."""
    centre, half = (boxes[:, :2] + boxes[:, 2:]) / 2, (boxes[:, 2:] - boxes[:, :2]) / 2
    offset = np.abs(points[None] - centre[:, None]) / np.maximum(half[:, None], 1e-9)
    return np.all(offset <= 1, axis=2), np.sqrt((offset**2).sum(2))


def _all_boxes(count: int, points_of: Callable[[int], list[int]]) -> list[Pair]:
    return [(i, points_of(i)) for i in range(count)]


def _lone_points(points: Iterable[int]) -> list[Pair]:
    return [(None, [j]) for j in points]


def to_prompts(boxes_xyxy: np.ndarray, points_xy: np.ndarray, pairing: Pairing) -> tuple[Prompt, ...]:
    """One segmenter prompt a region."""
    return tuple(
        Prompt(None if i is None else boxes_xyxy[i], points_xy[j].reshape(-1, 2))
        for i, j in pair(boxes_xyxy, points_xy, pairing)
    )
