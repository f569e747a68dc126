"""Drawn vessels: known kinds, with what a hand takes and what is poured into."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from a4agent.offline.training.pieces import DrawnThing, Rng
from a4agent.offline.training.vessels import VESSELS
from a4agent.offline.vocabulary import GRIP, INSIDE, KINDS


@pytest.mark.parametrize("make", VESSELS, ids=lambda make: make.__name__)
def test_every_maker_draws_a_known_kind(make: Callable[[Rng], DrawnThing]) -> None:
    for seed in range(20):
        thing = make(np.random.default_rng(seed))
        assert thing.kind in KINDS
        assert all(np.isfinite(piece.outline).all() and piece.outline.shape[1] == 2 for piece in thing.pieces)


def test_a_mug_has_a_grip_and_an_inside() -> None:
    mug = next(make for make in VESSELS if make.__name__ == "mug")
    assert {GRIP, INSIDE} <= {piece.part for piece in mug(np.random.default_rng(0)).pieces}
