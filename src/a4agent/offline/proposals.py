"""Where a thing could be: square windows of a picture, from what stands out and from a grid.

    main_box(rgb (H, W, 3) uint8, saliency (H, W)) -> (4,) float32 around what stands out most, or None
    windows(rgb, saliency)                         -> (n, 3) float32: centre x, centre y, side, in pixels
    cut(rgb, windows, 160)                         -> (n, 160, 160, 3) uint8

A window may reach beyond the picture; there the border's colours go on.
"""

from __future__ import annotations

import numpy as np

from a4agent.errors import require
from a4agent.imaging.masks import tight_box
from a4agent.offline.colour import to_lab
from a4agent.offline.surfaces import innermost

LOOSE = 1.4
"""The side of a window, of the longer side of the thing in it."""
LEVELS = (0.6, 0.2)
"""Saliency above which connected regions are proposals."""
SMALLEST = 0.0004
"""The least share of the picture of such a region."""
GRID = (0.6, 0.3)
"""Sides of the grid's windows, of the picture's shorter side."""
SURFACE_SIDE = 640
"""Pixels of the picture in which things on boards and sheets are looked for."""
MOST_FINE = 16
"""Windows of the finest grid: those with the most in them."""


def main_box(rgb: np.ndarray, saliency: np.ndarray) -> np.ndarray | None:
    """The box (4,) float32 around what stands out most; if that is a board or a sheet, around what lies on it."""
    cv2 = require("cv2", extra="offline")
    blob = _largest(saliency)
    shrink = min(1.0, SURFACE_SIDE / max(saliency.shape))
    small = cv2.resize(rgb, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA) if shrink < 1 else rgb
    size = small.shape[1], small.shape[0]
    whole = np.ones(saliency.shape, np.uint8) if blob is None else blob.astype(np.uint8)
    trail = innermost(to_lab(small, blur=0.6), cv2.resize(whole, size, interpolation=cv2.INTER_NEAREST) > 0)
    if blob is None and len(trail) == 1:
        return None
    box = tight_box(trail[-1])
    return None if box is None else box / shrink


def _largest(saliency: np.ndarray) -> np.ndarray | None:
    """The piece that stands out most, (H, W) bool."""
    cv2 = require("cv2", extra="offline")
    for level in (0.5, 0.2):
        _, labels = cv2.connectedComponents((saliency > level).astype(np.uint8))
        weights = np.bincount(labels.ravel(), weights=saliency.ravel())
        weights[0] = 0
        if weights.max() > 0.0005 * saliency.size:
            return labels == weights.argmax()
    return None


def windows(rgb: np.ndarray, saliency: np.ndarray) -> np.ndarray:
    """Proposals (n, 3), n > 0."""
    return np.concatenate([_salient(saliency), _grid(rgb, saliency)]).astype(np.float32)


def around(box_xyxy: np.ndarray, loose: float = LOOSE) -> np.ndarray:
    """The windows (n, 3) around boxes (n, 4); their sides are `loose` times the boxes' longer sides."""
    boxes = np.asarray(box_xyxy, np.float32).reshape(-1, 4)
    sides = np.maximum(boxes[:, 2:] - boxes[:, :2], 4).max(1)
    return np.column_stack([(boxes[:, :2] + boxes[:, 2:]) / 2, sides * loose])


def cut(rgb: np.ndarray, windows: np.ndarray, side: int) -> np.ndarray:
    """The windows' content, (n, side, side, 3) uint8."""
    cv2 = require("cv2", extra="offline")
    levels = [rgb]
    while min(levels[-1].shape[:2]) >= 32:
        levels.append(cv2.pyrDown(levels[-1]))
    crops = np.empty((len(windows), side, side, 3), np.uint8)
    for index, (x, y, length) in enumerate(windows):
        level = int(np.clip(np.floor(np.log2(max(length / side, 1.0))), 0, len(levels) - 1))
        picture = levels[level]
        fx, fy = picture.shape[1] / rgb.shape[1], picture.shape[0] / rgb.shape[0]
        sx, sy = length * fx / side, length * fy / side
        matrix = np.array(
            [[sx, 0, (x - length / 2) * fx + sx / 2 - 0.5], [0, sy, (y - length / 2) * fy + sy / 2 - 0.5]]
        )
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        crops[index] = cv2.warpAffine(picture, matrix, (side, side), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return crops


def _salient(saliency: np.ndarray) -> np.ndarray:
    """Windows around connected regions of each level."""
    cv2 = require("cv2", extra="offline")
    boxes: list[list[int]] = []
    for level in LEVELS:
        _, _, stats, _ = cv2.connectedComponentsWithStats((saliency > level).astype(np.uint8))
        found = [row for row in stats[1:] if row[cv2.CC_STAT_AREA] > SMALLEST * saliency.size]
        found.sort(key=lambda row: -row[cv2.CC_STAT_AREA])
        boxes += [[row[0], row[1], row[0] + row[2], row[1] + row[3]] for row in found[:4]]
    return around(np.array(boxes, np.float32)) if boxes else np.zeros((0, 3), np.float32)


def _grid(rgb: np.ndarray, saliency: np.ndarray) -> np.ndarray:
    """Overlapping windows of a few sizes; of the finest only those with something in them."""
    height, width = saliency.shape
    found: list[np.ndarray] = []
    for share in GRID:
        side = share * min(height, width)
        columns, rows = (max(1, round((length - side) / (side / 2)) + 1) for length in (width, height))
        xs = np.linspace(side / 2, width - side / 2, columns) if columns > 1 else np.array([width / 2])
        ys = np.linspace(side / 2, height - side / 2, rows) if rows > 1 else np.array([height / 2])
        x, y = (axis.ravel() for axis in np.meshgrid(xs, ys))
        found.append(np.column_stack([x, y, np.full(len(x), side)]))
    fine = found[-1]
    if len(fine) > MOST_FINE:
        found[-1] = fine[np.argsort(-_interest(rgb, saliency, fine))[:MOST_FINE]]
    return np.concatenate(found)


def _interest(rgb: np.ndarray, saliency: np.ndarray, windows: np.ndarray) -> np.ndarray:
    """How much stands out, or differs from its surroundings, in the middle of each window (n,)."""
    cv2 = require("cv2", extra="offline")
    small = cv2.resize(rgb, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA).astype(np.float32)
    side = float(windows[0, 2]) / 4
    near, far = (cv2.GaussianBlur(small, (0, 0), max(sigma, 0.3)) for sigma in (0.06 * side, 0.6 * side))
    odd = np.abs(near - far).sum(2) / 150
    odd += cv2.resize(saliency, odd.shape[::-1], interpolation=cv2.INTER_AREA)
    odd = cv2.blur(odd, (max(1, int(side * 0.5)),) * 2)
    columns = np.clip(windows[:, 0] / 4, 0, odd.shape[1] - 1).astype(int)
    rows = np.clip(windows[:, 1] / 4, 0, odd.shape[0] - 1).astype(int)
    return odd[rows, columns]
