"""Windows that things could be in, and what they show."""

from __future__ import annotations

import numpy as np
import pytest

from a4agent.offline import proposals


def picture(width: int = 320, height: int = 240) -> tuple[np.ndarray, np.ndarray]:
    """A dark table, and where a network sees a bright sheet on it that holds a small red thing."""
    rgb = np.full((height, width, 3), 40, np.uint8)
    rgb[40:200, 60:260] = 235
    rgb[110:130, 150:175] = (190, 20, 20)
    stands_out = np.zeros((height, width), np.float32)
    stands_out[40:200, 60:260] = 0.95
    return rgb, stands_out


def test_the_main_box_is_around_what_lies_on_a_sheet() -> None:
    rgb, stands_out = picture()
    box = proposals.main_box(rgb, stands_out)
    assert box is not None
    assert np.abs(box - [150, 110, 175, 130]).max() <= 4


def test_a_bare_sheet_is_all_that_stands_out() -> None:
    rgb, stands_out = picture()
    rgb[110:130, 150:175] = 235
    box = proposals.main_box(rgb, stands_out)
    assert box is not None
    assert np.abs(box - [60, 40, 260, 200]).max() <= 2


def test_where_nothing_stands_out_there_is_only_a_grid() -> None:
    rgb, blank = np.full((120, 200, 3), 90, np.uint8), np.zeros((120, 200), np.float32)
    assert proposals.main_box(rgb, blank) is None
    found = proposals.windows(rgb, blank)
    covered = np.zeros((120, 200), bool)
    for x, y, side in found:
        rows, columns = (slice(max(0, int(c - side / 2)), int(c + side / 2) + 1) for c in (y, x))
        covered[rows, columns] = True
    assert covered.all()


@pytest.mark.parametrize("side", [48, 160])
def test_a_window_shows_what_is_in_it(side: int) -> None:
    """A box lies in the middle of its window at every scale; beyond the picture its edge goes on."""
    rgb, _ = picture()
    window = proposals.around(np.array([150, 110, 175, 130], np.float32))
    assert window[0].tolist() == pytest.approx([162.5, 120, 25 * proposals.LOOSE])
    crop = proposals.cut(rgb, window, side)[0].astype(int)
    red = (crop[..., 0] - crop[..., 1]) > 80
    rows, columns = np.flatnonzero(red.any(1)), np.flatnonzero(red.any(0))
    assert (columns[-1] - columns[0] + 1) / side == pytest.approx(1 / proposals.LOOSE, abs=0.06)
    assert (rows[-1] - rows[0] + 1) / side == pytest.approx(0.8 / proposals.LOOSE, abs=0.06)
    outside = proposals.cut(rgb, np.array([[0, 0, 60]], np.float32), side)[0]
    assert (outside == 40).all()
