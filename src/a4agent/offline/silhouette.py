"""The object, cut out: zoom in on what stands out, grow it to its second material, clean its outline.

    find_object(rgb) -> Silhouette(box_xyxy=(209, 127, 409, 279), mask=(h, w) bool, lab=(h, w, 3))

A silhouette lives in a window around the object at a bounded resolution (the object's longer side is
about OBJECT_SIDE pixels), whatever the size of the photograph; `Silhouette.to_image` goes back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from a4agent.errors import require
from a4agent.offline import growth
from a4agent.offline.boxes import Box, box_around
from a4agent.offline.colour import to_lab, well_lit
from a4agent.offline.outline import outline
from a4agent.offline.saliency import saliency
from a4agent.offline.surfaces import innermost

IMAGE_SIDE = 1280
"""A larger picture is reduced to this before anything else."""
SURFACE_SIDE = 640
OBJECT_SIDE = 150
MOST_ENLARGED = 4.0
MARGIN = 0.75
"""Of the object's longer side, to each side of its window."""
WIDE_MARGIN = 3.0
"""For an object that goes on beyond its window."""
MOST_WINDOW = 450
LOOK = 0.35
"""The same, for the picture that the network sees."""


@dataclass(frozen=True, eq=False)
class Silhouette:
    """An object in its window: `box_xyxy` is the window in pixels of the image; `mask` (h, w) bool and
    `lab` (h, w, 3) float32 are at the window's own resolution."""

    box_xyxy: Box
    mask: np.ndarray
    lab: np.ndarray

    def to_image(self, mask: np.ndarray, size_wh: tuple[int, int]) -> np.ndarray:
        """A mask (h, w) of the window as a mask (H, W) bool of the image."""
        cv2 = require("cv2", extra="offline")
        x0, y0, x1, y1 = self.box_xyxy
        full = np.zeros((size_wh[1], size_wh[0]), bool)
        method = cv2.INTER_AREA if x1 - x0 < mask.shape[1] else cv2.INTER_LINEAR
        full[y0:y1, x0:x1] = cv2.resize(mask.astype(np.float32), (x1 - x0, y1 - y0), interpolation=method) >= 0.5
        return full


def find_object(rgb: np.ndarray, threads: int = 0, seen: np.ndarray | None = None) -> Silhouette | None:
    """The main object of a photograph (H, W, 3) uint8, None if nothing stands out from the background.

    `seen` (H, W) is the photograph's saliency, if it is known.
    """
    cv2 = require("cv2", extra="offline")
    height, width = rgb.shape[:2]
    if min(height, width) < 8:
        return None
    shrink = min(1.0, IMAGE_SIDE / max(height, width))
    picture = cv2.resize(rgb, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA) if shrink < 1 else rgb
    if int(picture.max()) - int(picture.min()) < 8:
        return None
    picture = well_lit(picture)
    if seen is None or seen.shape != picture.shape[:2]:
        seen = saliency(picture, threads)
    blob = _largest(seen)
    thing = _innermost(picture, np.ones(picture.shape[:2], bool) if blob is None else blob)
    if blob is None:
        if thing is None:
            return None
        blob = thing
    if thing is None and blob.mean() > 0.15 and not _is_whole(blob):
        blob = _centre_of(picture, blob, threads)
    found = cut_out(picture, blob if thing is None else thing, threads, seen, by_colour=thing is not None)
    return Silhouette(_scaled(found.box_xyxy, 1 / shrink, width, height), found.mask, found.lab)


def enlarged(silhouette: Silhouette, factor: float, size_wh: tuple[int, int]) -> Silhouette:
    """The silhouette in a picture of `size_wh` that is larger by `factor`."""
    return Silhouette(_scaled(silhouette.box_xyxy, factor, *size_wh), silhouette.mask, silhouette.lab)


def cut_out(
    rgb: np.ndarray, rough: np.ndarray, threads: int = 0, seen: np.ndarray | None = None, by_colour: bool = False
) -> Silhouette:
    """The object that a rough mask (H, W) bool, not blank, marks, in its window.

    `seen` is what the network said (H, W) of the whole picture, if it was asked. `by_colour` says that the
    mask was found by its colour and may be trusted in detail.
    """
    certainty = _look(rgb, rough, threads, seen)
    found, cut_off = _in_window(rgb, rough, certainty, MARGIN, by_colour)
    if not cut_off:
        return found
    # Only a piece of something long was marked: find all of it, then look again.
    wide, _ = _in_window(rgb, rough, certainty, WIDE_MARGIN, by_colour)
    whole = wide.to_image(wide.mask, (rgb.shape[1], rgb.shape[0]))
    if not whole.any():
        return found
    return _in_window(rgb, whole, _look(rgb, whole, threads, seen), MARGIN, by_colour=True)[0]


def _look(rgb: np.ndarray, rough: np.ndarray, threads: int, seen: np.ndarray | None) -> np.ndarray:
    """What the network says (H, W) float32 of the surroundings of a rough mask."""
    x0, y0, x1, y1 = box_around(rough, LOOK)
    if seen is not None and (x1 - x0) * (y1 - y0) > 0.75 * rough.size:
        return seen  # a closer look would show the same
    certainty = np.zeros(rough.shape, np.float32)
    certainty[y0:y1, x0:x1] = saliency(np.ascontiguousarray(rgb[y0:y1, x0:x1]), threads)
    return certainty


def _in_window(
    rgb: np.ndarray, rough: np.ndarray, certainty: np.ndarray, margin: float, by_colour: bool
) -> tuple[Silhouette, bool]:
    """The object in a window with this margin, and whether the window is too small for it."""
    cv2 = require("cv2", extra="offline")
    height, width = rough.shape
    x0, y0, x1, y1 = box = box_around(rough, margin)
    tight = box_around(rough, 0.0)
    scale = min(MOST_ENLARGED, OBJECT_SIDE / max(tight[2] - tight[0], tight[3] - tight[1]))
    scale = min(scale, MOST_WINDOW / max(x1 - x0, y1 - y0))
    size = max(4, round((x1 - x0) * scale)), max(4, round((y1 - y0) * scale))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    window = cv2.resize(rgb[y0:y1, x0:x1], size, interpolation=method)
    prior = cv2.resize(rough[y0:y1, x0:x1].astype(np.float32), size) > 0.5
    mask, odd = outline(window, cv2.resize(certainty[y0:y1, x0:x1], size), prior, by_colour)
    cut_off = growth.runs_out(mask, odd, (x0 > 0, y0 > 0, x1 < width, y1 < height))
    return Silhouette(box, mask, to_lab(window, blur=0.8)), cut_off


def _largest(certainty: np.ndarray) -> np.ndarray | None:
    """The piece that stands out most, (H, W) bool."""
    cv2 = require("cv2", extra="offline")
    for threshold in (0.5, 0.2):
        _, labels = cv2.connectedComponents((certainty > threshold).astype(np.uint8))
        weights = np.bincount(labels.ravel(), weights=certainty.ravel())
        weights[0] = 0
        if weights.max() > 0.0005 * certainty.size:
            return labels == weights.argmax()
    return None


def _innermost(rgb: np.ndarray, blob: np.ndarray) -> np.ndarray | None:
    """What lies on top of `blob`, (H, W) bool; None if it is no surface."""
    cv2 = require("cv2", extra="offline")
    shrink = min(1.0, SURFACE_SIDE / max(blob.shape))
    small = cv2.resize(rgb, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA) if shrink < 1 else rgb
    lab = to_lab(small, blur=0.6)
    size = lab.shape[1], lab.shape[0]
    trail = innermost(lab, cv2.resize(blob.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0)
    if len(trail) == 1:
        return None
    return cv2.resize(trail[-1].astype(np.uint8), blob.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0


def _is_whole(blob: np.ndarray) -> bool:
    """Whether a blob has an outline of its own, rather than being a convex sheet or cut off by the picture's border."""
    cv2 = require("cv2", extra="offline")
    contours, _ = cv2.findContours(blob.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    outline = max(contours, key=cv2.contourArea)
    return cv2.contourArea(outline) < 0.93 * cv2.contourArea(cv2.convexHull(outline))


def _centre_of(rgb: np.ndarray, blob: np.ndarray, threads: int) -> np.ndarray:
    """A smaller thing in the middle of `blob`, if the network sees a whole one there; else `blob`."""
    x0, y0, x1, y1 = box_around(blob, 0.0)
    dx, dy = int(0.18 * (x1 - x0)), int(0.18 * (y1 - y0))
    x0, y0, x1, y1 = x0 + dx, y0 + dy, x1 - dx, y1 - dy
    inner = _largest(saliency(np.ascontiguousarray(rgb[y0:y1, x0:x1]), threads))
    if inner is None:
        return blob
    on_border = inner[0].any() or inner[-1].any() or inner[:, 0].any() or inner[:, -1].any()
    if on_border or not 0.004 < inner.mean() < 0.5:
        return blob
    found = np.zeros_like(blob)
    found[y0:y1, x0:x1] = inner
    return found


def _scaled(box: Box, factor: float, width: int, height: int) -> Box:
    x0, y0, x1, y1 = (round(value * factor) for value in box)
    return x0, y0, min(width, max(x1, x0 + 1)), min(height, max(y1, y0 + 1))
