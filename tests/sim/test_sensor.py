"""The sensor changes how a picture looks, not where things are."""

from __future__ import annotations

import numpy as np

from a4agent.sim.sensor import expose


def _scene() -> np.ndarray:
    picture = np.full((60, 80, 3), 90, np.uint8)
    picture[20:40, 30:60] = (200, 120, 60)
    return picture


def test_the_same_generator_gives_the_same_noise() -> None:
    first, second, other = (expose(_scene(), np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert (first == second).all()
    assert (first != other).any()
    assert first.shape == (60, 80, 3)
    assert first.dtype == np.uint8


def test_edges_stay_where_they_were() -> None:
    for seed in range(10):
        seen = expose(_scene(), np.random.default_rng(seed)).astype(int)
        inside, outside = seen[24:36, 35:55].mean((0, 1)), seen[5:15, 5:25].mean((0, 1))
        nearer = np.abs(seen - inside).sum(2) < np.abs(seen - outside).sum(2)
        truth = np.zeros((60, 80), bool)
        truth[20:40, 30:60] = True
        assert (nearer == truth).mean() > 0.97


def test_a_bright_picture_does_not_burn_out() -> None:
    bright = np.full((60, 80, 3), 250, np.uint8)
    bright[20:40, 30:60] = 235
    for seed in range(10):
        assert (expose(bright, np.random.default_rng(seed)) == 255).mean() < 0.05
