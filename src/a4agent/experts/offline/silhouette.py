"""The object, cut out: zoom in on what stands out, grow it to its second material, clean its outline.

    find_object(rgb) -> Silhouette(box_xyxy=(209, 127, 409, 279), mask=(h, w) bool, lab=(h, w, 3))

A silhouette lives in a window around the object at a bounded resolution (the object's longer side is
about OBJECT_SIDE pixels), whatever the size of the photograph; `Silhouette.to_image` goes back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from a4agent.errors import require
from a4agent.experts.offline import growth
from a4agent.experts.offline.colour import palette, to_lab, unlike
from a4agent.experts.offline.saliency import saliency
from a4agent.experts.offline.surfaces import innermost

IMAGE_SIDE = 1280
"""A larger picture is reduced to this before anything else."""
SURFACE_SIDE = 640
OBJECT_SIDE = 150
MOST_ENLARGED = 4.0
MARGIN = 0.75
"""Of the object's longer side, to each side of its window."""
LOOK = 0.35
"""The same, for the picture that the network sees."""

Box = tuple[int, int, int, int]


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


def find_object(rgb: np.ndarray, threads: int = 0) -> Silhouette | None:
    """The main object of a photograph (H, W, 3) uint8, None if nothing stands out from the background."""
    cv2 = require("cv2", extra="offline")
    height, width = rgb.shape[:2]
    if min(height, width) < 8:
        return None
    shrink = min(1.0, IMAGE_SIDE / max(height, width))
    picture = cv2.resize(rgb, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA) if shrink < 1 else rgb
    if int(picture.max()) - int(picture.min()) < 8:
        return None
    blob = _largest(saliency(picture, threads))
    if blob is None:
        return None
    blob = _innermost(picture, blob)
    if blob.mean() > 0.15 and not _is_whole(blob):
        blob = _centre_of(picture, blob, threads)
    found = cut_out(picture, blob, threads)
    return Silhouette(_scaled(found.box_xyxy, 1 / shrink, width, height), found.mask, found.lab)


def cut_out(rgb: np.ndarray, rough: np.ndarray, threads: int = 0) -> Silhouette:
    """The object that a rough mask (H, W) bool, not blank, marks, in its window."""
    cv2 = require("cv2", extra="offline")
    box = _box_around(rough, MARGIN)
    x0, y0, x1, y1 = box
    tight = _box_around(rough, 0.0)
    scale = min(MOST_ENLARGED, OBJECT_SIDE / max(tight[2] - tight[0], tight[3] - tight[1]))
    size = max(4, round((x1 - x0) * scale)), max(4, round((y1 - y0) * scale))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    window = cv2.resize(rgb[y0:y1, x0:x1], size, interpolation=method)
    prior = cv2.resize(rough[y0:y1, x0:x1].astype(np.float32), size) > 0.5

    u0, v0, u1, v1 = _box_around(rough, LOOK)
    looked = saliency(np.ascontiguousarray(rgb[v0:v1, u0:u1]), threads)
    certainty = np.zeros(rough.shape, np.float32)
    certainty[v0:v1, u0:u1] = looked
    certainty = cv2.resize(certainty[y0:y1, x0:x1], size)
    return Silhouette(box, _refine(window, certainty, prior), to_lab(window, blur=0.8))


def _refine(window: np.ndarray, certainty: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """The object's mask (h, w) from what the network says and what does not look like the local background."""
    cv2 = require("cv2", extra="offline")
    square = np.ones((3, 3), np.uint8)
    sure = certainty > 0.5
    if not (sure | prior).any():
        return prior
    lab = to_lab(window, blur=0.8)
    reach = int(0.6 * np.sqrt(max(sure.sum(), prior.sum())))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    around = cv2.dilate((sure | prior).astype(np.uint8), disc) > 0
    background = around & (certainty < 0.15) & (cv2.dilate(prior.astype(np.uint8), square, iterations=5) == 0)
    colours = palette(lab[background])
    if not colours:
        return _main_pieces(sure if sure.any() else prior, sure | prior)
    distance = unlike(lab, colours)
    enough = float(np.clip(1.8 * np.percentile(distance[background], 85), 8.0, 14.0))
    core = sure | (prior & (distance > enough))
    if not core.any():
        return prior
    object_ = growth.attached(core, distance > 1.2 * enough)
    object_ = growth.aligned(object_, distance > 0.8 * enough)

    labels = np.where(object_, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    certain = ((certainty > 0.9) | (object_ & ~core)) & (distance > enough)
    labels[cv2.erode(certain.astype(np.uint8), square, iterations=3) > 0] = cv2.GC_FGD
    outside = cv2.dilate(object_.astype(np.uint8), square, iterations=8) == 0
    labels[outside] = cv2.GC_BGD
    labels[(distance < 0.6 * enough) & (certainty < 0.6)] = cv2.GC_BGD
    return _main_pieces(_grab_cut(window, labels, ~outside, object_), object_)


def _grab_cut(window: np.ndarray, labels: np.ndarray, region: np.ndarray, start: np.ndarray) -> np.ndarray:
    """`start` with its outline drawn to the edges of the picture (Rother et al., SIGGRAPH 2004), inside `region`."""
    cv2 = require("cv2", extra="offline")
    x0, y0, x1, y1 = _box_around(region, 0.05)
    part = np.ascontiguousarray(labels[y0:y1, x0:x1])
    if (part == cv2.GC_BGD).sum() < 50 or (start[y0:y1, x0:x1]).sum() < 20:
        return start
    cv2.setRNGSeed(0)
    smooth = np.ascontiguousarray(cv2.GaussianBlur(window, (0, 0), 0.8)[y0:y1, x0:x1])
    cv2.grabCut(smooth, part, None, np.zeros((1, 65)), np.zeros((1, 65)), 3, cv2.GC_INIT_WITH_MASK)
    drawn = np.zeros_like(start)
    drawn[y0:y1, x0:x1] = (part == cv2.GC_FGD) | (part == cv2.GC_PR_FGD)
    return drawn if drawn.sum() > 0.4 * start.sum() else start


def _main_pieces(mask: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The pieces of `mask` that hold most of `wanted`."""
    cv2 = require("cv2", extra="offline")
    _, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    held = np.bincount(labels.ravel(), weights=wanted.ravel().astype(np.float64))
    held[0] = 0
    if held.max() == 0:
        return mask
    return np.isin(labels, np.flatnonzero((held > 0.1 * held.max()) & (held > 0)))


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


def _innermost(rgb: np.ndarray, blob: np.ndarray) -> np.ndarray:
    """What lies on top of `blob`, or `blob` itself."""
    cv2 = require("cv2", extra="offline")
    shrink = min(1.0, SURFACE_SIDE / max(blob.shape))
    small = cv2.resize(rgb, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA) if shrink < 1 else rgb
    lab = to_lab(small, blur=0.6)
    size = lab.shape[1], lab.shape[0]
    trail = innermost(lab, cv2.resize(blob.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0)
    if len(trail) == 1:
        return blob
    return cv2.resize(trail[-1].astype(np.uint8), blob.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0


def _is_whole(blob: np.ndarray) -> bool:
    """Whether a blob has an outline of its own, rather than being a convex sheet or cut off by the picture's border."""
    cv2 = require("cv2", extra="offline")
    contours, _ = cv2.findContours(blob.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    outline = max(contours, key=cv2.contourArea)
    return cv2.contourArea(outline) < 0.93 * cv2.contourArea(cv2.convexHull(outline))


def _centre_of(rgb: np.ndarray, blob: np.ndarray, threads: int) -> np.ndarray:
    """A smaller thing in the middle of `blob`, if the network sees a whole one there; else `blob`."""
    x0, y0, x1, y1 = _box_around(blob, 0.0)
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


def _box_around(mask: np.ndarray, margin: float) -> Box:
    """The box around a mask, wider by `margin` of its longer side, inside the picture."""
    height, width = mask.shape
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    x0, y0, x1, y1 = int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
    more = round(margin * max(x1 - x0, y1 - y0))
    return max(0, x0 - more), max(0, y0 - more), min(width, x1 + more), min(height, y1 + more)


def _scaled(box: Box, factor: float, width: int, height: int) -> Box:
    x0, y0, x1, y1 = (round(value * factor) for value in box)
    return x0, y0, min(width, max(x1, x0 + 1)), min(height, max(y1, y0 + 1))
