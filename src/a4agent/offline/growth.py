"""What the network left out of an object: the black handle beside a bright blade, the steel beyond a gap.

Both functions take the object so far and `odd`, the pixels (H, W) bool that do not look like the
background, and return a larger object (H, W) bool. They add what hangs together with it, or what
continues its long axis, and nothing that runs out of the window or dwarfs it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from a4agent.errors import require

MOST = 3.0
"""The largest piece that may join, of the area of the object so far."""


def attached(core: np.ndarray, odd: np.ndarray) -> np.ndarray:
    """`core` with the odd pieces next to it that reach further than a blurred edge would."""
    cv2 = require("cv2", extra="offline")
    near = cv2.morphologyEx((odd | core).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    _, labels = cv2.connectedComponents(near)
    candidates = odd & ~core & np.isin(labels, np.setdiff1d(labels[core], [0]))
    away = cv2.distanceTransform((~core).astype(np.uint8), cv2.DIST_L2, 3)
    size = np.sqrt(core.sum())
    grown = core.copy()
    for piece in _pieces(candidates):
        if piece.sum() <= MOST * core.sum() and away[piece].max() >= 0.08 * size + 3:
            grown |= piece
    return grown


def runs_out(core: np.ndarray, odd: np.ndarray, sides: tuple[bool, bool, bool, bool]) -> bool:
    """Whether a piece that could be the rest of `core` is cut off by the window.

    `sides` says which sides of the window (left, top, right, bottom) have more picture beyond them.
    """
    cv2 = require("cv2", extra="offline")
    _, labels = cv2.connectedComponents((odd | core).astype(np.uint8))
    for label in np.setdiff1d(labels[core], [0]):
        whole = labels == label
        edges = whole[:, 0].any(), whole[0].any(), whole[:, -1].any(), whole[-1].any()
        if any(a and b for a, b in zip(edges, sides, strict=True)) and (whole & ~core).sum() < MOST * core.sum():
            return True
    return False


def aligned(core: np.ndarray, odd: np.ndarray) -> np.ndarray:
    """`core` with the odd pieces just beyond the ends of its long axis; a compact core has none."""
    cv2 = require("cv2", extra="offline")
    points = np.argwhere(core)[:, ::-1].astype(np.float32)
    if len(points) < 20:
        return core
    middle = points.mean(0)
    variances, axes = np.linalg.eigh(np.cov((points - middle).T))
    if variances[1] < 2.5 * variances[0]:
        return core
    across, along = axes[:, 0], axes[:, 1]
    positions = (points - middle) @ along
    start, end = positions.min(), positions.max()
    length, half_width = end - start, np.percentile(np.abs((points - middle) @ across), 95)
    grown = core.copy()
    beside = cv2.dilate(core.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    for piece in _pieces(odd & ~beside):
        area = piece.sum()
        if not 0.004 * len(points) + 6 < area < 1.2 * len(points):
            continue
        offsets = np.argwhere(piece)[:, ::-1] - middle
        t, v = offsets @ along, offsets @ across
        gap = max(t.min() - end, start - t.max())
        reach = max(t.max() - end, start - t.min())
        centred = np.abs(v).max() < 1.5 * half_width and abs(v.mean()) < 0.5 * half_width
        if centred and gap < 0.25 * length and 0.1 * length < reach < 1.5 * length:
            grown |= piece
    return grown


def _pieces(mask: np.ndarray) -> Iterator[np.ndarray]:
    """The connected pieces of `mask` that do not touch the window's border."""
    cv2 = require("cv2", extra="offline")
    height, width = mask.shape
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    for label in range(1, count):
        x, y, w, h = stats[label, :4]
        if x > 1 and y > 1 and x + w < width - 1 and y + h < height - 1 and stats[label, cv2.CC_STAT_AREA] > 5:
            yield labels == label
