"""Drawings to train on: the truth fits the picture, and the same seed draws the same."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from a4agent.offline.training.canvas import SIDE
from a4agent.offline.training.drawings import FAMILIES, draw
from a4agent.offline.training.pieces import DrawnThing, Rng
from a4agent.offline.vocabulary import KINDS

MAKERS = [make for makers, _ in FAMILIES for make in makers]


@pytest.mark.parametrize("make", MAKERS, ids=lambda make: make.__name__)
def test_every_maker_draws_a_known_kind(make: Callable[[Rng], DrawnThing]) -> None:
    for seed in range(20):
        thing = make(np.random.default_rng(seed))
        assert thing.kind in KINDS
        assert all(np.isfinite(piece.outline).all() and piece.outline.shape[1] == 2 for piece in thing.pieces)


def test_the_same_seed_draws_the_same() -> None:
    one, other = draw(np.random.default_rng(3)), draw(np.random.default_rng(3))
    assert (one.image == other.image).all()
    assert (one.parts == other.parts).all()
    assert one.kind == other.kind


def test_the_truth_fits_the_picture() -> None:
    """Labelled pixels look unlike their surroundings, on most drawings."""
    apart: list[float] = []
    for seed in range(40):
        drawing = draw(np.random.default_rng([1, seed]))
        assert drawing.image.shape == (SIDE, SIDE, 3)
        assert drawing.image.dtype == drawing.parts.dtype == np.uint8
        assert (drawing.kind == "none") == (not drawing.parts.any())
        if drawing.parts.any():
            shown = drawing.parts > 0
            apart.append(float(np.abs(drawing.image[shown].mean(0) - drawing.image[~shown].mean(0)).max()))
    assert np.median(apart) > 15
