"""The coordinate systems that models answer in, and the one way from each to pixels of the original image.

    to_pixels([[500, 250]], THOUSAND, size_wh=(640, 480))        -> [[320.0, 120.0]]
    to_pixels([[0.5, 0.25]], UNIT, size_wh=(640, 480))           -> [[320.0, 120.0]]
    to_pixels([[999, 0]], BINS_999, size_wh=(640, 480))          -> [[640.0, 0.0]]
    to_pixels([[420, 210]], resized(840, 840), size_wh=(640, 480)) -> [[320.0, 120.0]]

An adapter declares its model's system; it is never guessed from a type or from the range of the numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class CoordinateSystem:
    """Where a model's right edge (`width`) and bottom edge (`height`) lie; None: at the image's own, in pixels."""

    name: str
    width: float | None
    height: float | None


PIXELS = CoordinateSystem("pixels", None, None)
UNIT = CoordinateSystem("unit", 1.0, 1.0)
THOUSAND = CoordinateSystem("thousand", 1000.0, 1000.0)
BINS_999 = CoordinateSystem("bins of 999", 999.0, 999.0)


def resized(width: float, height: float) -> CoordinateSystem:
    """Pixels of the image as the model's own processor resized it."""
    if width <= 0 or height <= 0:
        raise ValueError(f"a resized image has positive sides, not {width!r} x {height!r}")
    return CoordinateSystem("resized", float(width), float(height))


def to_pixels(values: np.ndarray | Sequence[object], system: CoordinateSystem, size_wh: tuple[int, int]) -> np.ndarray:
    """Convert (..., 2k) numbers, alternately x and y, to pixels of an image of `size_wh`; float64, same shape.

    Nothing is clipped or ordered: coordinates outside the image stay outside.

    Raises:
        ValueError: the last axis is odd.
    """
    array = np.asarray(values, dtype=np.float64)
    if array.size == 0:
        return array
    if array.shape[-1] % 2:
        raise ValueError(f"coordinates come in pairs, not {array.shape[-1]} at a time")
    if system.width is None or system.height is None:
        return array
    edge = np.tile([system.width, system.height], array.shape[-1] // 2)
    return array * np.tile(size_wh, array.shape[-1] // 2) / edge  # in this order halves of whole numbers are exact
