"""Where a mask lies, and how deep: whole-pixel boxes (x0, y0, x1, y1) and distances to its border."""

from __future__ import annotations

import numpy as np

from a4agent.errors import require

Box = tuple[int, int, int, int]


def box_around(mask: np.ndarray, margin: float) -> Box:
    """The box around a mask (H, W) bool that is not blank, wider by `margin` of its longer side, inside the picture."""
    height, width = mask.shape
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    x0, y0, x1, y1 = int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
    more = round(margin * max(x1 - x0, y1 - y0))
    return max(0, x0 - more), max(0, y0 - more), min(width, x1 + more), min(height, y1 + more)


def depth_in(mask: np.ndarray) -> np.ndarray:
    """How far each pixel of a mask (h, w) bool is from what is not in it, (h, w) float32; beyond the picture is not."""
    cv2 = require("cv2", extra="offline")
    return cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
