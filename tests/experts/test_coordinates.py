"""Coordinate systems, each against numbers worked out by hand, and there and back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from a4agent.experts.coordinates import BINS_999, PIXELS, THOUSAND, UNIT, CoordinateSystem, resized, to_pixels

SIZE = (640, 480)


@pytest.mark.parametrize(
    ("values", "system", "pixels"),
    [
        ([0.5, 0.25], UNIT, [320, 120]),
        ([500, 250, 1000, 1000], THOUSAND, [320, 120, 640, 480]),
        ([999, 0], BINS_999, [640, 0]),
        ([420, 210], resized(840, 840), [320, 120]),
        ([12.5, 7], PIXELS, [12.5, 7]),
        ([-100, 1500], THOUSAND, [-64, 720]),
    ],
)
def test_by_hand(values: list[float], system: CoordinateSystem, pixels: list[float]) -> None:
    np.testing.assert_allclose(to_pixels(values, system, SIZE), pixels)


def test_whole_numbers_that_end_between_two_pixels_do_so_exactly() -> None:
    assert to_pixels([564, 420], resized(840, 840), (35, 27)).tolist() == [23.5, 13.5]


@given(st.lists(st.tuples(st.floats(0, 1), st.floats(0, 1)), max_size=5), st.integers(1, 9000), st.integers(1, 9000))
def test_every_system_gives_the_same_pixels(unit: list[tuple[float, float]], width: int, height: int) -> None:
    values = np.array(unit).reshape(-1, 2)
    pixels = to_pixels(values, UNIT, (width, height))
    for system, edge in ((THOUSAND, (1000, 1000)), (BINS_999, (999, 999)), (resized(28, 56), (28, 56))):
        np.testing.assert_allclose(to_pixels(values * edge, system, (width, height)), pixels, atol=1e-6)


def test_shapes_are_kept_and_odd_ones_refused() -> None:
    assert to_pixels(np.zeros((3, 2, 4)), UNIT, SIZE).shape == (3, 2, 4)
    assert to_pixels([], UNIT, SIZE).size == 0
    with pytest.raises(ValueError, match="pairs"):
        to_pixels([1, 2, 3], UNIT, SIZE)
    with pytest.raises(ValueError, match="positive"):
        resized(0, 5)
