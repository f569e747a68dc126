"""Drawn furniture, appliances and switches: known kinds, with something to pull, press or turn."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from a4agent.offline.training.fixtures import FIXTURES
from a4agent.offline.training.pieces import DrawnThing, Rng
from a4agent.offline.vocabulary import CONTROL, GRIP, KINDS


@pytest.mark.parametrize("make", FIXTURES, ids=lambda make: make.__name__)
def test_every_maker_draws_a_known_kind(make: Callable[[Rng], DrawnThing]) -> None:
    for seed in range(20):
        thing = make(np.random.default_rng(seed))
        assert thing.kind in KINDS
        assert all(np.isfinite(piece.outline).all() and piece.outline.shape[1] == 2 for piece in thing.pieces)


def test_most_have_something_to_pull_press_or_turn() -> None:
    asked = {GRIP, CONTROL}
    without = [
        make.__name__ for make in FIXTURES if not asked & {p.part for p in make(np.random.default_rng(1)).pieces}
    ]
    assert set(without) <= {"box", "lamp"}
