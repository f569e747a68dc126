"""Drawn vessels have what a hand takes and what is poured into."""

from __future__ import annotations

import numpy as np

from a4agent.offline.training.vessels import VESSELS
from a4agent.offline.vocabulary import GRIP, INSIDE


def test_a_mug_has_a_grip_and_an_inside() -> None:
    mug = next(make for make in VESSELS if make.__name__ == "mug")
    assert {GRIP, INSIDE} <= {piece.part for piece in mug(np.random.default_rng(0)).pieces}
