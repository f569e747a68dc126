"""The flow tracker on motions that are known exactly."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from a4agent.errors import UnknownNameError
from a4agent.video.trackers import FlowTracker, create

cv2 = pytest.importorskip("cv2")
RNG = np.random.default_rng(0)
GROUND = cv2.GaussianBlur(RNG.integers(0, 255, (240, 320), np.uint8).astype(np.uint8), (0, 0), 3)
PATCH = cv2.GaussianBlur(RNG.integers(0, 255, (240, 320), np.uint8).astype(np.uint8), (0, 0), 2)
MASK = np.zeros((240, 320), bool)
MASK[90:150, 110:190] = True


def scene(motion: np.ndarray) -> tuple[Image.Image, np.ndarray]:
    """The patch inside the mask moved over the ground by a (2, 3) affine motion, and where its mask is then."""
    mask = cv2.warpAffine(MASK.astype(np.uint8), motion, (320, 240)).astype(bool)
    moved = cv2.warpAffine(PATCH, motion, (320, 240))
    return Image.fromarray(np.where(mask, moved, GROUND)).convert("RGB"), mask


def turned(degrees: float, scale: float, dx: float, dy: float) -> np.ndarray:
    motion = cv2.getRotationMatrix2D((150, 120), degrees, scale)
    return motion + np.array([[0, 0, dx], [0, 0, dy]])


def test_a_part_that_moves_and_turns_is_followed() -> None:
    tracker = FlowTracker()
    tracker.start(scene(turned(0, 1, 0, 0))[0], MASK)
    for k in range(1, 21):
        frame, truth = scene(turned(1.5 * k, 1 + 0.005 * k, 2.0 * k, -1.0 * k))
        found = tracker.step(frame)
        iou = (found.mask & truth).sum() / (found.mask | truth).sum()
        assert iou > 0.85, k
        assert found.quality > 0.5, k


def test_a_part_that_is_gone_is_lost() -> None:
    tracker = FlowTracker()
    tracker.start(scene(turned(0, 1, 0, 0))[0], MASK)
    assert tracker.step(Image.fromarray(GROUND).convert("RGB")).quality < 0.4
    assert tracker.step(Image.new("RGB", (320, 240))).quality < 0.4
    assert tracker.step(Image.new("RGB", (64, 48))).quality == 0.0


def test_a_plain_frame_has_nothing_to_follow() -> None:
    tracker = FlowTracker()
    tracker.start(Image.new("RGB", (320, 240), "grey"), MASK)
    assert tracker.step(Image.new("RGB", (320, 240), "grey")).quality == 0.0


def test_trackers_are_found_by_name() -> None:
    assert isinstance(create("flow", points=10), FlowTracker)
    with pytest.raises(UnknownNameError, match="flow"):
        create("flwo")
