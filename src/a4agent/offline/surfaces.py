"""Looking past the table: a wide shot's most salient thing is often the board, tray or sheet that the tool lies on.

A blob is a *surface* if it is large, convex and mostly of one colour; the *things* on it are the
blobs inside that differ from this colour and do not hang on to its edge. A sheet of paper on a board
is a thing that is a surface again, so `innermost` goes on until there is nothing left to peel.
"""

from __future__ import annotations

import numpy as np

from a4agent.errors import require
from a4agent.offline.colour import SAME, dominant

DIFFERENT = 11.0
"""A pixel this far from the surface's colour belongs to something else."""
LEAST_SURFACE = 0.04
"""A surface fills at least this share of the picture."""
LEAST_THING = 0.006
"""A thing fills at least this share of the surface; what is smaller is its grain, a reflection or a screw."""
DEPTH = 3


def innermost(lab: np.ndarray, blob: np.ndarray) -> list[np.ndarray]:
    """The blob (H, W) bool, the thing on it, the thing on that ...: at most 1 + DEPTH masks, each inside the last."""
    trail = [blob]
    while len(trail) <= DEPTH:
        found = things_on(lab, trail[-1], strict=len(trail) > 1)
        if found is None:
            break
        trail.append(found)
    return trail


def things_on(lab: np.ndarray, blob: np.ndarray, strict: bool) -> np.ndarray | None:
    """The most central thing that lies on `blob`, (H, W) bool; None if it is not a surface or is bare.

    `strict` asks for a quadrilateral: what was found on a surface is more likely a tool than a sheet.
    """
    cv2 = require("cv2", extra="offline")
    if blob.mean() < LEAST_SURFACE:
        return None
    outline = _outline(blob, strict)
    if outline is None:
        return None
    area = cv2.contourArea(outline)
    inner = cv2.drawContours(np.zeros(blob.shape, np.uint8), [outline], -1, 1, -1)
    inner = cv2.erode(inner, np.ones((3, 3), np.uint8), iterations=max(2, int(0.02 * np.sqrt(area)))) > 0
    if inner.sum() < 50:
        return None
    colour = dominant(lab[inner])
    distance = np.linalg.norm(lab - colour, axis=2)
    if (distance[inner] < SAME).mean() < 0.5:
        return None

    odd = ((distance > DIFFERENT) & inner).astype(np.uint8)
    odd = cv2.morphologyEx(odd, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    edge = inner & (cv2.erode(inner.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)
    sheet = _has_four_corners(outline)
    moments = cv2.moments(outline)
    centre = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
    best, best_cost = None, 0.45
    count, labels, stats, centroids = cv2.connectedComponentsWithStats(odd)
    for label in range(1, count):
        share = stats[label, cv2.CC_STAT_AREA] / area
        if not LEAST_THING < share < 0.5 or stats[label, cv2.CC_STAT_AREA] < 20:
            continue
        thing = labels == label
        contours, _ = cv2.findContours(thing.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        on_edge = (thing & edge).sum() / max(cv2.arcLength(max(contours, key=len), True), 1.0)
        off_centre = np.linalg.norm(centroids[label] - centre) / np.sqrt(area)
        inside_frame = sheet and share > 0.1 and off_centre < 0.2
        if not inside_frame and (thing & blob).sum() < 0.6 * thing.sum():
            continue  # a hole in the blob, as a handle has
        cost = off_centre + on_edge - 2.0 * min(share, 0.1)
        if on_edge < 0.22 and cost < best_cost:
            best, best_cost = thing, cost
    return best


def _outline(blob: np.ndarray, strict: bool) -> np.ndarray | None:
    """The contour of a blob whose shape a surface could have, else None."""
    cv2 = require("cv2", extra="offline")
    pad = 12
    solid = cv2.morphologyEx(np.pad(blob.astype(np.uint8), pad), cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8))
    whole = _largest(solid[pad:-pad, pad:-pad])
    if whole is None:
        return None
    filled = cv2.drawContours(np.zeros(blob.shape, np.uint8), [whole], -1, 1, -1)
    # Whatever hangs on to its corners and edges is cut off before the shape is judged.
    for brush in (0.16,) if strict else (0.08, 0.35):
        side = max(3, int(brush * np.sqrt(cv2.contourArea(whole))))
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
        outline = _largest(cv2.morphologyEx(filled, cv2.MORPH_OPEN, kernel))
        if outline is None or (brush > 0.3 and cv2.contourArea(outline) < 0.87 * cv2.contourArea(whole)):
            continue
        convex = cv2.contourArea(outline) >= 0.96 * cv2.contourArea(cv2.convexHull(outline))
        if convex and (not strict or _has_four_corners(outline)):
            return outline
    return None


def _has_four_corners(outline: np.ndarray) -> bool:
    cv2 = require("cv2", extra="offline")
    hull = cv2.convexHull(outline)
    corners = cv2.approxPolyDP(hull, 0.04 * cv2.arcLength(hull, True), True)
    return len(corners) == 4 and 0.9 < cv2.contourArea(outline) / max(cv2.contourArea(corners), 1.0) < 1.16


def _largest(mask: np.ndarray) -> np.ndarray | None:
    cv2 = require("cv2", extra="offline")
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    largest = max(contours, key=cv2.contourArea, default=None)
    return largest if largest is not None and cv2.contourArea(largest) >= 100 else None
