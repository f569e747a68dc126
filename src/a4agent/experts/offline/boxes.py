"""Whole-pixel boxes (x0, y0, x1, y1) around masks."""

from __future__ import annotations

import numpy as np

Box = tuple[int, int, int, int]


def box_around(mask: np.ndarray, margin: float) -> Box:
    """The box around a mask (H, W) bool that is not blank, wider by `margin` of its longer side, inside the picture."""
    height, width = mask.shape
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    x0, y0, x1, y1 = int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
    more = round(margin * max(x1 - x0, y1 - y0))
    return max(0, x0 - more), max(0, y0 - more), min(width, x1 + more), min(height, y1 + more)
