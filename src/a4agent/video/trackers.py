"""Trackers follow a mask from one frame to the next.

    tracker = create("flow")
    tracker.start(first_frame, mask)
    tracker.step(next_frame)            -> Tracked(mask=..., quality=0.93)

A tracker is a class behind an entry point of the group `a4agent.trackers`; its keyword-only parameters are settings.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from PIL.Image import Image

from a4agent.errors import require
from a4agent.plugins import Plugins
from a4agent.protocols import Tracked, Tracker

TRACKERS = Plugins("a4agent.trackers", "tracker")


def create(name: str, **settings: Any) -> Tracker:
    """The tracker that a package registered as `name`.

    Raises:
        UnknownNameError: no such tracker; the message suggests the nearest.
    """
    return TRACKERS.find(name)(**settings)


class FlowTracker:
    """Optical flow of corner points, and the affine motion that most of them agree on. Needs OpenCV and no model.

    Points start in the frame where the mask was given, so errors do not add up from mask to mask. Quality is the
    share of points that survive (forward-backward error under a pixel) and agree, times how alike the patch still is.

    Source: Lucas and Kanade (1981); Kalal et al., Forward-Backward Error (2010).
    """

    def __init__(self, *, points: int = 200, backward_error: float = 1.0) -> None:
        self._cv2: Any = require("cv2", extra="offline")
        self._most = points
        self._backward_error = backward_error
        self.close()

    def start(self, frame: Image, mask: np.ndarray) -> None:
        cv2 = self._cv2
        self._mask = mask
        self._first = self._last = _grey(frame)
        reach = max(round(0.02 * float(np.hypot(*mask.shape))), 2)
        around = cv2.dilate(mask.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
        corners = cv2.goodFeaturesToTrack(self._first, self._most, 0.01, 3, mask=around)
        self._from = np.zeros((0, 2), np.float32) if corners is None else corners.reshape(-1, 2)
        self._now = self._from.copy()
        self._started_with = len(self._from)

    def step(self, frame: Image) -> Tracked:
        cv2 = self._cv2
        grey = _grey(frame)
        blank = Tracked(np.zeros(grey.shape, bool), 0.0)
        if len(self._now) < 3 or grey.shape != self._last.shape:
            return blank
        there, found, _ = cv2.calcOpticalFlowPyrLK(self._last, grey, self._now[:, None], None)
        back, found_back, _ = cv2.calcOpticalFlowPyrLK(grey, self._last, there, None)
        error = np.abs(back[:, 0] - self._now).max(1)
        kept = (found[:, 0] == 1) & (found_back[:, 0] == 1) & (error < self._backward_error)
        self._from, self._now, self._last = self._from[kept], there[:, 0][kept], grey
        if len(self._now) < 3:
            return blank
        motion, agree = cv2.estimateAffine2D(self._from, self._now, ransacReprojThreshold=3.0)
        if motion is None or not np.isfinite(motion).all():
            return blank
        size = (grey.shape[1], grey.shape[0])
        mask = cv2.warpAffine(self._mask.astype(np.uint8), motion, size, flags=cv2.INTER_NEAREST).astype(bool)
        expected = cv2.warpAffine(self._first, motion, size, flags=cv2.INTER_LINEAR)
        share = float(agree.sum()) / max(self._started_with, 1)
        return Tracked(mask, min(share * 1.5, 1.0) * _likeness(expected, grey, mask))

    def close(self) -> None:
        self._mask = np.zeros((0, 0), bool)
        self._first = self._last = np.zeros((0, 0), np.uint8)
        self._from = self._now = np.zeros((0, 2), np.float32)
        self._started_with = 0


def _grey(frame: Image) -> np.ndarray:
    return np.asarray(frame.convert("L"))


def _likeness(expected: np.ndarray, seen: np.ndarray, mask: np.ndarray) -> float:
    """Normalised correlation of two grey pictures inside a mask, 0..1; 1 where both are plain."""
    if mask.sum() < 9:
        return 0.0
    a, b = expected[mask].astype(np.float64), seen[mask].astype(np.float64)
    a, b = a - a.mean(), b - b.mean()
    scale = float(np.sqrt((a * a).sum() * (b * b).sum()))
    if scale < mask.sum():  # under a grey level of contrast there is nothing to correlate
        return 1.0
    return max(float((a * b).sum()) / scale, 0.0)
