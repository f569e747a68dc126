"""A tool is cut where it changes, whichever way it lies."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from a4agent.offline.profile import Layout, Profile

SPOON, SCREWDRIVER = Layout(0.65, 1.9), Layout(0.5, 0.45, steel=True)


def tool(grip: int, wide: int, work: int, width: int, degrees: float) -> tuple[Profile, np.ndarray]:
    """A grip and a working end, side by side and turned; the profile and the grip's mask."""
    mask, part = np.zeros((300, 300), np.uint8), np.zeros((300, 300), np.uint8)
    start = 150 - (grip + work) // 2
    mask[150 - wide // 2 : 150 + wide // 2, start : start + grip] = 1
    part[:] = mask
    mask[150 - width // 2 : 150 + width // 2, start + grip : start + grip + work] = 1
    turn = cv2.getRotationMatrix2D((150, 150), degrees, 1)
    mask, part = (cv2.warpAffine(m, turn, (300, 300), flags=cv2.INTER_NEAREST) > 0 for m in (mask, part))
    lab = np.zeros((300, 300, 3), np.float32)
    lab[..., 0] = 40
    return Profile.of(mask, lab), part


@pytest.mark.parametrize("degrees", [0, 37, 90, 180, 251])
@pytest.mark.parametrize(
    ("layout", "sizes"), [(SPOON, (130, 10, 60, 36)), (SPOON, (110, 12, 70, 30)), (SCREWDRIVER, (90, 34, 90, 10))]
)
def test_the_cut_lies_where_the_width_changes(layout: Layout, sizes: tuple[int, ...], degrees: float, overlap) -> None:
    profile, grip = tool(*sizes, degrees)
    assert overlap(profile.between(*profile.cut(layout)[0]), grip) > 0.85


def test_the_two_parts_share_nothing_but_their_border() -> None:
    profile, _ = tool(130, 10, 60, 36, 20)
    grip, work = (profile.between(*span) for span in profile.cut(SPOON))
    assert ((grip | work) == profile.mask).all()
    assert (grip & work).sum() <= 0.03 * profile.mask.sum()


def test_colour_alone_can_tell() -> None:
    mask = np.zeros((60, 240), bool)
    mask[20:40, 20:220] = True
    lab = np.zeros((60, 240, 3), np.float32)
    lab[:, :110] = [30, 50, 30]
    lab[:, 110:] = [60, 0, 0]
    profile = Profile.of(mask, lab)
    (start, end), _ = profile.cut(Layout(0.42, 1.1, steel=True))
    assert abs((end - start) - 0.45) < 0.05
    assert profile.between(start, end)[30, 40]


def test_a_single_pixel_has_a_profile() -> None:
    mask = np.zeros((5, 5), bool)
    mask[2, 2] = True
    profile = Profile.of(mask, np.zeros((5, 5, 3), np.float32))
    for span in profile.cut(SPOON):
        assert profile.between(*span).shape == (5, 5)
