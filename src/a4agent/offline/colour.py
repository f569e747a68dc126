"""Colour as the offline experts compare it: Lab with its lightness turned down, so that shading counts less than hue.

to_lab(rgb (H, W, 3) uint8) -> (H, W, 3) float32
dominant(colours (n, 3)) -> (3,), the colour most of them have
"""

from __future__ import annotations

import numpy as np

from a4agent.errors import require

WEIGHTS = np.array([0.7, 1.0, 1.0], np.float32)
SAME = 14.0
"""Two colours nearer than this are shades of one material."""


def to_lab(rgb: np.ndarray, blur: float = 0.0) -> np.ndarray:
    """(H, W, 3) uint8 -> (H, W, 3) float32, smoothed by a Gaussian of `blur` pixels first."""
    cv2 = require("cv2", extra="offline")
    if blur:
        rgb = cv2.GaussianBlur(rgb, (0, 0), blur)
    return cv2.cvtColor(rgb.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB) * WEIGHTS


def well_lit(rgb: np.ndarray) -> np.ndarray:
    """An underexposed picture (H, W, 3) uint8 made as bright as a good one, so that thresholds mean the same."""
    bright = float(np.percentile(rgb[::4, ::4].max(2), 99))
    gain = float(np.clip(215.0 / max(bright, 1.0), 1.0, 2.5))
    return rgb if gain < 1.05 else np.minimum(rgb.astype(np.float32) * gain, 255.0).astype(np.uint8)


def dominant(colours: np.ndarray) -> np.ndarray:
    """The mean (3,) of the largest cluster of `colours` (n, 3), n > 0."""
    cells = ((colours + 128.0) / np.array([7, 6, 6], np.float32)).astype(np.int64)
    keys = (cells[:, 0] * 64 + cells[:, 1]) * 64 + cells[:, 2]
    _, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
    mean = colours[inverse.ravel() == counts.argmax()].mean(0)
    for _ in range(3):
        near = np.linalg.norm(colours - mean, axis=1) < SAME
        if near.any():
            mean = colours[near].mean(0)
    return mean


def name_of(colours: np.ndarray) -> str:
    """The plain name ("red", "black") of the colour that most of `colours` (n, 3) uint8 RGB have; "grey" of none."""
    if not len(colours):
        return "grey"
    hsv = _hsv(colours)
    names = np.array([_NAMES.index(_name(*one)) for one in hsv[:: max(1, len(hsv) // 400)]])
    return _NAMES[int(np.bincount(names).argmax())]


_NAMES = ("black", "white", "grey", "red", "orange", "yellow", "green", "blue", "purple", "pink", "brown", "beige")
_HUES = ((14, "red"), (40, "orange"), (68, "yellow"), (165, "green"), (255, "blue"), (290, "purple"), (345, "pink"))


def _hsv(colours: np.ndarray) -> np.ndarray:
    cv2 = require("cv2", extra="offline")
    return cv2.cvtColor(np.ascontiguousarray(colours[None], np.uint8).astype(np.float32) / 255, cv2.COLOR_RGB2HSV)[0]


def _name(hue: float, saturation: float, value: float) -> str:
    if value < 0.2 or (value < 0.3 and saturation < 0.35):
        return "black"
    if saturation < 0.16:
        return "white" if value > 0.78 else "grey"
    name = next((name for most, name in _HUES if hue < most), "red")
    if name in ("red", "orange") and hue > 8 and value < 0.62:
        return "brown"
    if name in ("orange", "yellow") and saturation < 0.42:
        return "beige" if value > 0.6 else "brown"
    return "pink" if name == "red" and saturation < 0.5 and value > 0.7 else name
