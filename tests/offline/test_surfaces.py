"""A board is looked past, a sheet on a board too; what is no surface stays."""

from __future__ import annotations

import cv2
import numpy as np

from a4agent.offline.colour import to_lab
from a4agent.offline.surfaces import innermost, things_on


def picture(*layers: tuple[np.ndarray, tuple[int, int, int]]) -> np.ndarray:
    rgb = np.full((240, 320, 3), 190, np.uint8)
    for mask, colour in layers:
        rgb[mask] = colour
    return to_lab(rgb)


def polygon(*points: tuple[int, int]) -> np.ndarray:
    return cv2.fillPoly(np.zeros((240, 320), np.uint8), [np.array(points, np.int32)], 1) > 0


BOARD = polygon((40, 60), (260, 30), (300, 200), (70, 225))
SHEET = polygon((110, 80), (225, 75), (235, 175), (115, 180))
TOOL = polygon((140, 120), (205, 118), (206, 130), (141, 132))


def test_the_thing_on_a_board_is_found() -> None:
    trail = innermost(picture((BOARD, (20, 24, 22)), (TOOL, (200, 30, 30))), BOARD)
    assert len(trail) == 2
    assert (trail[1] & TOOL).sum() / (trail[1] | TOOL).sum() > 0.8


def test_the_thing_on_a_sheet_on_a_board_is_found() -> None:
    trail = innermost(picture((BOARD, (20, 24, 22)), (SHEET, (235, 235, 240)), (TOOL, (200, 30, 30))), BOARD)
    assert len(trail) == 3
    assert (trail[2] & TOOL).sum() / (trail[2] | TOOL).sum() > 0.8


def test_a_sheet_that_the_network_left_out_of_the_board_is_on_it() -> None:
    trail = innermost(picture((BOARD, (20, 24, 22)), (SHEET, (235, 235, 240)), (TOOL, (200, 30, 30))), BOARD & ~SHEET)
    assert len(trail) == 3
    assert (trail[2] & TOOL).sum() / (trail[2] | TOOL).sum() > 0.8


def test_a_bare_board_is_what_there_is() -> None:
    assert len(innermost(picture((BOARD, (20, 24, 22))), BOARD)) == 1


def test_a_reflection_on_a_tool_is_not_a_thing_on_a_board() -> None:
    glint = polygon((150, 120), (158, 120), (158, 126), (150, 126))
    assert 20 < glint.sum() < 0.006 * BOARD.sum()
    assert len(innermost(picture((BOARD, (20, 24, 22)), (glint, (240, 240, 240))), BOARD)) == 1


def test_what_hangs_on_the_edge_is_not_on_the_board() -> None:
    marker = polygon((40, 60), (75, 55), (80, 95), (45, 100))
    assert things_on(picture((BOARD, (20, 24, 22)), (marker, (240, 240, 240))), BOARD, strict=False) is None


def test_a_handles_hole_is_not_a_thing() -> None:
    mug = polygon((80, 60), (200, 60), (200, 200), (80, 200))
    loop = polygon((200, 80), (250, 80), (250, 180), (200, 180))
    hole = polygon((205, 100), (235, 100), (235, 160), (205, 160))
    blob = (mug | loop) & ~hole
    assert things_on(picture((blob, (240, 240, 240)), (hole, (190, 190, 190))), blob, strict=False) is None


def test_a_small_or_crooked_blob_is_no_surface() -> None:
    small = polygon((100, 100), (120, 100), (120, 120), (100, 120))
    assert things_on(picture((small, (0, 0, 0))), small, strict=False) is None
    star = polygon((160, 20), (180, 110), (300, 120), (180, 140), (160, 230), (140, 140), (20, 120), (140, 110))
    assert things_on(picture((star, (0, 0, 0)), (TOOL, (200, 30, 30))), star, strict=False) is None
