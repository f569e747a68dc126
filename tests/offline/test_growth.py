"""The second material joins the object; the rest of the picture does not."""

from __future__ import annotations

import numpy as np

from a4agent.offline.growth import aligned, attached, runs_out


def block(y0: int, y1: int, x0: int, x1: int) -> np.ndarray:
    mask = np.zeros((100, 200), bool)
    mask[y0:y1, x0:x1] = True
    return mask


HANDLE = block(45, 55, 40, 100)


def test_a_handle_next_to_it_joins() -> None:
    blade = block(46, 54, 101, 150)
    assert (attached(HANDLE, blade) == HANDLE | blade).all()


def test_a_blurred_edge_does_not() -> None:
    assert (attached(HANDLE, block(43, 57, 38, 102)) == HANDLE).all()


def test_the_background_does_not() -> None:
    assert (attached(HANDLE, block(46, 54, 101, 200)) == HANDLE).all()  # runs out of the window
    assert (attached(HANDLE, block(5, 95, 101, 190)) == HANDLE).all()  # dwarfs the object


def test_what_continues_the_axis_beyond_a_gap_joins() -> None:
    tip = block(47, 53, 108, 140)
    assert (aligned(HANDLE, tip) == HANDLE | tip).all()


def test_what_lies_beside_or_far_off_does_not() -> None:
    assert (aligned(HANDLE, block(70, 76, 108, 140)) == HANDLE).all()
    assert (aligned(HANDLE, block(47, 53, 150, 190)) == HANDLE).all()


def test_a_compact_object_has_no_axis() -> None:
    square = block(30, 70, 60, 100)
    assert (aligned(square, block(45, 55, 105, 130)) == square).all()


def test_an_object_that_leaves_the_window_is_noticed_where_there_is_more_to_see() -> None:
    odd = block(46, 54, 100, 200)
    assert runs_out(HANDLE, odd, (True, True, True, True))
    assert not runs_out(HANDLE, odd, (True, True, False, True))
    assert not runs_out(HANDLE, block(46, 54, 120, 200), (True, True, True, True))
