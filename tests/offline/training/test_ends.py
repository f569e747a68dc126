"""Grips and blades of drawn tools."""

from __future__ import annotations

import numpy as np

from a4agent.offline.training import ends
from a4agent.offline.training.pieces import plain
from a4agent.offline.vocabulary import GRIP, WORK


def test_a_grip_ends_where_the_blade_begins() -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        grip = ends.grip_pieces(rng, 0.5, 0.1, 0.08, plain(rng))
        assert {piece.part for piece in grip} <= {GRIP, 0}
        assert max(piece.outline[:, 0].max() for piece in grip) < 0.6
        blade = ends.blade_pieces(rng, 0.5, plain(rng))
        assert WORK in {piece.part for piece in blade}
        assert min(piece.outline[:, 0].min() for piece in blade if piece.part == WORK) > 0.3


def test_one_material_or_two() -> None:
    rng = np.random.default_rng(0)
    grip, work = ends.materials(rng, metal_share=0.5, same_share=1.0)
    assert np.abs(grip.colour / np.maximum(work.colour, 1) - 1).max() < 0.5
