"""Outlines that things are made of."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from a4agent.offline.training.pieces import ellipse, line, rectangle, rotate, strip


def area(outline: np.ndarray) -> float:
    return float(cv2.contourArea(outline.astype(np.float32)))


def test_areas() -> None:
    assert area(rectangle(0, 0, 2, 3)) == pytest.approx(6)
    assert area(ellipse(0, 0, 2, 1, n=200)) == pytest.approx(2 * np.pi, rel=0.01)
    assert area(strip(line(0, 0, 10, 0), 0.5)) == pytest.approx(5, rel=0.01)


def test_a_turn_keeps_the_form() -> None:
    turned = rotate(rectangle(0, 0, 2, 1), 90)
    assert np.ptp(turned, axis=0) == pytest.approx([1, 2])
