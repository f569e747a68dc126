"""Drawn tools: known kinds, each with a grip and a working end."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from a4agent.offline.training.pieces import DrawnThing, Rng
from a4agent.offline.training.tools import TOOLS
from a4agent.offline.vocabulary import GRIP, KINDS, WORK


@pytest.mark.parametrize("make", TOOLS, ids=lambda make: make.__name__)
def test_every_maker_draws_a_known_kind(make: Callable[[Rng], DrawnThing]) -> None:
    for seed in range(20):
        thing = make(np.random.default_rng(seed))
        assert thing.kind in KINDS
        assert all(np.isfinite(piece.outline).all() and piece.outline.shape[1] == 2 for piece in thing.pieces)


@pytest.mark.parametrize("make", TOOLS, ids=lambda make: make.__name__)
def test_tools_have_a_grip_and_a_working_end(make: Callable[[Rng], DrawnThing]) -> None:
    parts = {piece.part for piece in make(np.random.default_rng(0)).pieces}
    assert {GRIP, WORK} <= parts
