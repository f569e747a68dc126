"""`offline:parts` as a segmenter: the thing, part or piece of material that a box and points mark.

Regions that some phrase could mean come first; a prompt that fits none of them gets what stands out inside its box, or
the even-coloured patch around its points.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from a4agent.errors import A4Error, require
from a4agent.imaging.masks import box_area, box_iou, box_overlap, tight_box
from a4agent.offline import revision
from a4agent.offline.choice import regions
from a4agent.offline.colour import to_lab
from a4agent.offline.eye import forget, look, look_closer
from a4agent.offline.seen_object import SeenObject
from a4agent.protocols import ExpertBase, Prompt, Segmentation, SegmentRequest

FITS = 0.7
"""A region whose box overlaps the prompt's by this much is what the prompt means."""
NEAR = 0.3
"""A region whose box in its window overlaps the prompt's by less is not looked at in the picture's own pixels."""
CLOSER_LOOKS = 3
"""How many of the regions that fit best are looked at from nearby."""
CUT_OUT_SIDE = 320
"""Pixels of the window in which a box that fits no region is looked at."""


class OfflineSegmenter(ExpertBase):
    """A Segmenter with one candidate per prompt."""

    def __init__(self, *, threads: int = 0) -> None:
        super().__init__("offline:parts", revision=revision())
        self.threads = threads

    def segment(self, requests: Sequence[SegmentRequest]) -> list[Segmentation | A4Error]:
        return [self._segment(request) for request in requests]

    def _segment(self, request: SegmentRequest) -> Segmentation:
        things = look(request.image, self.threads)
        width, height = request.image.size
        masks = np.zeros((len(request.prompts), 1, height, width), bool)
        scores = np.zeros((len(request.prompts), 1), np.float32)
        for index, prompt in enumerate(request.prompts):
            masks[index, 0], scores[index, 0] = self._one(request, things, prompt)
        return Segmentation(masks, scores)

    def _one(self, request: SegmentRequest, things: Sequence[SeenObject], prompt: Prompt) -> tuple[np.ndarray, float]:
        """A mask (H, W) bool and how well it fits the prompt, 0..1."""
        mask, fit = self._best_region(things, prompt)
        if mask is not None and (fit >= FITS or prompt.box_xyxy is None):
            return mask, fit
        if prompt.box_xyxy is None:
            return _patch(np.asarray(request.image.convert("RGB")), prompt.points_xy), 0.3
        return _cut_out(np.asarray(request.image.convert("RGB")), prompt.box_xyxy), 0.5

    def _best_region(self, things: Sequence[SeenObject], prompt: Prompt) -> tuple[np.ndarray | None, float]:
        """The region that fits a prompt best: by its box, or the smallest around its points; all points inside it."""
        candidates: list[tuple[float, SeenObject, np.ndarray]] = []
        for thing in things:
            if prompt.box_xyxy is not None and not box_overlap(thing.box_xyxy, prompt.box_xyxy):
                continue
            for region in regions(thing):
                if prompt.box_xyxy is not None and (
                    not region.any() or box_iou(thing.box_of(region), prompt.box_xyxy) < NEAR
                ):
                    continue
                candidates.append((_fit(thing.region(region), prompt), thing, region))
        candidates.sort(key=lambda candidate: -candidate[0])
        best, best_fit = None, 0.0
        for _, thing, region in candidates[:CLOSER_LOOKS]:
            mask = look_closer(thing, region, self.threads)
            if (fit := _fit(mask, prompt)) > best_fit:
                best, best_fit = mask, fit
        return best, best_fit

    def close(self) -> None:
        forget()


def _fit(mask: np.ndarray, prompt: Prompt) -> float:
    """How well a mask (H, W) bool fits a prompt, 0..1."""
    box = tight_box(mask)
    if box is None:
        return 0.0
    inside = _share_inside(mask, prompt.points_xy)
    if prompt.box_xyxy is None:
        return float(inside == 1.0) / (1.0 + float(mask.mean()))
    fit = float(box_iou(box, prompt.box_xyxy)) * (0.5 + 0.5 * inside)
    return fit / (1 + 0.1 * float(mask.sum() / box_area(box)))  # a rim, rather than what it surrounds


def _share_inside(mask: np.ndarray, points_xy: np.ndarray) -> float:
    if not len(points_xy):
        return 1.0
    height, width = mask.shape
    columns, rows = np.floor(points_xy).astype(int).T
    within = (columns >= 0) & (rows >= 0) & (columns < width) & (rows < height)
    return float((mask[rows.clip(0, height - 1), columns.clip(0, width - 1)] & within).mean())


def _cut_out(rgb: np.ndarray, box_xyxy: np.ndarray) -> np.ndarray:
    """What differs from the surroundings of a box, (H, W) bool, by GrabCut; the box where all or nothing does."""
    cv2 = require("cv2", extra="offline")
    height, width = rgb.shape[:2]
    x0, y0 = np.clip(np.floor(box_xyxy[:2]), 0, [width - 1, height - 1]).astype(int)
    x1, y1 = np.clip(np.ceil(box_xyxy[2:]), [x0 + 1, y0 + 1], [width, height]).astype(int)
    box = np.zeros((height, width), bool)
    box[y0:y1, x0:x1] = True
    around = max(8, (x1 - x0) // 2, (y1 - y0) // 2)
    window = slice(max(0, y0 - around), y1 + around), slice(max(0, x0 - around), x1 + around)
    shrink = min(1.0, CUT_OUT_SIDE / max(rgb[window].shape))
    small = cv2.resize(rgb[window], None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    inside = cv2.resize(box[window].astype(np.uint8), small.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    labels = np.where(inside > 0, cv2.GC_PR_FGD, cv2.GC_BGD).astype(np.uint8)
    if min(x1 - x0, y1 - y0) < 8 or inside.all():
        return box
    cv2.setRNGSeed(0)
    cv2.grabCut(small, labels, None, np.zeros((1, 65)), np.zeros((1, 65)), 3, cv2.GC_INIT_WITH_MASK)
    found = (labels == cv2.GC_PR_FGD).astype(np.uint8)
    full = np.zeros((height, width), bool)
    full[window] = cv2.resize(found, rgb[window].shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0
    return full & box if (full & box).any() else box


def _patch(rgb: np.ndarray, points_xy: np.ndarray) -> np.ndarray:
    """The even-coloured patches (H, W) bool that points lie in."""
    cv2 = require("cv2", extra="offline")
    height, width = rgb.shape[:2]
    lab = np.ascontiguousarray(to_lab(rgb, blur=1.0))
    patch = np.zeros((height + 2, width + 2), np.uint8)
    flags = 4 | cv2.FLOODFILL_MASK_ONLY | cv2.FLOODFILL_FIXED_RANGE | (1 << 8)
    for x, y in np.clip(np.floor(points_xy), 0, [width - 1, height - 1]).astype(int):
        cv2.floodFill(lab, patch, (int(x), int(y)), 0, (10.0,) * 3, (10.0,) * 3, flags)
    return patch[1:-1, 1:-1] > 0
