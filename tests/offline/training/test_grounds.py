"""Grounds: of the size that was asked for, all different."""

from __future__ import annotations

import numpy as np
import pytest

from a4agent.offline.training.grounds import ground, marker, noise, sheet, texture


def test_grounds_and_textures_have_their_size_and_differ() -> None:
    for draw in (ground, texture):
        images = [draw(np.random.default_rng(seed), 120) for seed in range(6)]
        assert {image.shape for image in images} == {(120, 120, 3)}
        assert all(np.isfinite(image).all() for image in images)
        assert len({image.tobytes() for image in images}) == 6


@pytest.mark.parametrize("coarse", [0.0, 0.5, 1.0])
def test_noise_has_a_deviation_of_about_one(coarse: float) -> None:
    fields = [noise(np.random.default_rng(seed), 200, 300, coarse) for seed in range(20)]
    assert fields[0].shape == (200, 300)
    assert 0.4 < np.mean([field.std() for field in fields]) < 1.5


@pytest.mark.parametrize("lay", [marker, sheet])
def test_a_marker_or_sheet_changes_the_ground_around_its_middle_alone(lay) -> None:
    before = np.full((200, 200, 3), 120, np.float32)
    after = before.copy()
    lay(np.random.default_rng(3), after, (0.5, 0.5), 0.15)
    changed = (after != before).any(2)
    assert changed[90:110, 90:110].any()
    assert not changed[:40].any()
