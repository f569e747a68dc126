"""What sticks out of an object's body: a mug's loop, a pan's handle, a kettle's spout.

    body, pieces = split(mask)      # body (h, w) bool, pieces: what is left, largest first

The body is what a wide brush can paint without leaving the outline (a morphological opening); a
piece that encloses a hole is a loop.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from a4agent.errors import require
from a4agent.offline.boxes import depth_in

BRUSH = 0.55
"""The brush's radius, of the radius of the largest disc inside the object."""


@dataclass(frozen=True, eq=False)
class Piece:
    """`mask` (h, w) bool without its hole; `hole` in pixels; `length` and `width` in pixels."""

    mask: np.ndarray
    hole: int
    length: float
    width: float

    @property
    def area(self) -> int:
        return int(self.mask.sum())


def split(mask: np.ndarray) -> tuple[np.ndarray, list[Piece]]:
    """The body of an object (h, w) bool and what sticks out of it; slivers along the outline are left out."""
    cv2 = require("cv2", extra="offline")
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = cv2.drawContours(np.zeros(mask.shape, np.uint8), contours, -1, 1, -1)
    holes = _large_holes(filled.astype(bool) & ~mask, mask.sum())
    depth = depth_in(mask | (filled.astype(bool) & ~holes))
    radius = max(1.0, BRUSH * float(depth.max()))
    core = depth >= radius
    _, labels = cv2.connectedComponents(core.astype(np.uint8))
    largest = labels == (np.bincount(labels[core]).argmax() if core.any() else 0)
    reach = cv2.distanceTransform((~largest).astype(np.uint8), cv2.DIST_L2, 5)
    body = mask & (reach <= radius + 1.5)

    rest = (mask | holes) & ~body
    count, labels, stats, _ = cv2.connectedComponentsWithStats(rest.astype(np.uint8), connectivity=4)
    pieces: list[Piece] = []
    for label in range(1, count):
        area = stats[label, cv2.CC_STAT_AREA]
        if area < 0.008 * mask.sum() or area < 8:
            continue
        whole = labels == label
        piece = whole & mask
        out = float(reach[whole].max() - radius)
        if not piece.any() or out < 0.15 * radius:
            continue
        (_, sides, _) = cv2.minAreaRect(np.argwhere(whole)[:, ::-1].astype(np.float32))
        pieces.append(Piece(piece, int((whole & holes).sum()), max(sides) + 1, min(sides) + 1))
    return body, sorted(pieces, key=lambda piece: -piece.area)


def _large_holes(holes: np.ndarray, area: int) -> np.ndarray:
    """Holes that are no specks."""
    cv2 = require("cv2", extra="offline")
    _, labels, stats, _ = cv2.connectedComponentsWithStats(holes.astype(np.uint8), connectivity=4)
    large = np.flatnonzero(stats[:, cv2.CC_STAT_AREA] > max(6, 0.004 * area))
    return holes & np.isin(labels, large[large > 0])
