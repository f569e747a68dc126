"""Small things on a larger one: a refrigerator's handle, a kettle's switch, a remote control's buttons.

    found = list(details(mask, lab))
    longest(found) -> (h, w) bool or None       a bar
    most_compact(found) -> (h, w) bool or None  a knob, a button
    widest_ellipse(found, mask) -> ...          the inside of a cup

They are pieces inside the outline that differ from the material around them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from a4agent.errors import require
from a4agent.offline.boxes import depth_in
from a4agent.offline.colour import dominant

BAR = 3.3
"""The slimness from which on something is a bar."""


@dataclass(frozen=True, eq=False)
class Detail:
    """`share` of the object's area, `elongation` of the box around it, `contrast` to the object's material, and
    `on_border`, the share of it that lies along the object's outline."""

    mask: np.ndarray
    share: float
    slimness: float
    elongation: float
    fullness: float
    contrast: float
    on_border: float


def slimness(mask: np.ndarray) -> float:
    """How many times its thickness a region (h, w) bool, not blank, extends: of a straight bar and of a bent one."""
    return _slimness(mask, _sides(mask))


def _slimness(mask: np.ndarray, sides: tuple[float, float]) -> float:
    return float(np.hypot(*sides)) / (2 * float(depth_in(mask).max()))


def _sides(mask: np.ndarray) -> tuple[float, float]:
    """The sides of the smallest box around a region (h, w) bool, not blank, at whatever angle."""
    cv2 = require("cv2", extra="offline")
    return cv2.minAreaRect(np.argwhere(mask)[:, ::-1].astype(np.float32))[1]


def longest(found: Sequence[Detail]) -> np.ndarray | None:
    """The detail that is most like a bar."""
    bars = [detail for detail in found if detail.slimness > BAR and detail.share < 0.2]

    def likeness(bar: Detail) -> float:
        apart = 1.0 - 0.8 * bar.on_border  # a door's frame and a shelf's edge are no handles
        return bar.contrast * np.sqrt(bar.share) * apart

    best = max(bars, key=likeness, default=None)
    return best.mask if best else most_compact(found)


def most_compact(found: Sequence[Detail]) -> np.ndarray | None:
    """The detail that is most like a knob or button."""
    spots = [detail for detail in found if detail.share < 0.15]
    best = max(spots, key=lambda d: d.fullness * d.contrast * np.sqrt(d.share) / d.elongation, default=None)
    return best.mask if best else None


def widest_ellipse(found: Sequence[Detail], mask: np.ndarray) -> np.ndarray | None:
    """The largest elliptical area (h, w) bool that a detail of the object (h, w) bool surrounds, in its upper part."""
    cv2 = require("cv2", extra="offline")
    rows = np.flatnonzero(mask.any(1))
    best, largest = None, 0.08 * mask.sum()
    for detail in found:
        contours, _ = cv2.findContours(detail.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        hull = cv2.convexHull(max(contours, key=len))
        if len(hull) < 8:
            continue
        blank = np.zeros(mask.shape, np.uint8)
        area = cv2.fillConvexPoly(blank.copy(), hull, 1) > 0
        (x, y), axes, angle = cv2.fitEllipse(hull)
        if min(axes) < 3 or y > rows[0] + 0.6 * len(rows):
            continue
        ellipse = cv2.ellipse(blank, ((x, y), axes, angle), 1, -1) > 0
        fits = (area & ellipse).sum() / (area | ellipse).sum()
        if fits > 0.88 and largest < (ellipse & mask).sum() < 0.7 * mask.sum():
            best, largest = ellipse & mask, int((ellipse & mask).sum())
    return best


def details(mask: np.ndarray, lab: np.ndarray) -> Iterator[Detail]:
    """The details of an object (h, w) bool with the colours `lab` (h, w, 3), specks and large areas left out."""
    cv2 = require("cv2", extra="offline")
    area = int(mask.sum())
    inner = cv2.erode(np.pad(mask, 1).astype(np.uint8), np.ones((3, 3), np.uint8), iterations=3)[1:-1, 1:-1] > 0
    if inner.sum() < 50:
        return
    # The material around each place, so that a door's shading is no detail.
    wide = max(5, int(0.12 * np.sqrt(area)))
    weight = cv2.GaussianBlur(inner.astype(np.float32), (0, 0), wide) + 1e-6
    around = cv2.GaussianBlur(lab * inner[..., None], (0, 0), wide) / weight[..., None]
    distance = np.minimum(
        np.linalg.norm(lab - around, axis=2), np.linalg.norm(lab - dominant(lab[inner]), axis=2) + 4.0
    )
    odd = ((distance > max(7.0, float(np.percentile(distance[inner], 80)))) & inner).astype(np.uint8)
    odd = cv2.morphologyEx(odd, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    border = depth_in(mask) < 4.0 + 0.03 * np.sqrt(area)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(odd)
    for label in range(1, count):
        size = stats[label, cv2.CC_STAT_AREA]
        if size < max(8, 0.001 * area) or size > 0.4 * area:
            continue
        piece = labels == label
        sides = _sides(piece)
        long, short = max(sides) + 1, min(sides) + 1
        yield Detail(
            piece,
            share=size / area,
            slimness=_slimness(piece, sides),
            elongation=long / short,
            fullness=min(1.0, size / (long * short)),
            contrast=float(distance[piece].mean()),
            on_border=float(border[piece].mean()),
        )
