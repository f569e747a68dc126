"""Boxes in perspective, and the fittings on their front."""

from __future__ import annotations

import numpy as np
import pytest

from a4agent.offline.training.pieces import plain
from a4agent.offline.training.solids import BoxView, bar_handle, case, cuboid, knob, on_front
from a4agent.offline.vocabulary import BODY, CONTROL, GRIP

FRONT_ON = BoxView(yaw=0.0, pitch=0.0, distance=5.0)


def test_what_is_nearer_is_larger() -> None:
    near, far = (on_front(FRONT_ON, np.array([[0.0, 0.0], [1.0, 0.0]]), z) for z in (0.5, -0.5))
    assert np.ptp(near[:, 0]) > 1 > np.ptp(far[:, 0])


def test_a_box_seen_from_the_front_shows_one_face_whole() -> None:
    rng = np.random.default_rng(0)
    faces = cuboid(FRONT_ON, np.array([-1.0, -1, -1]), np.array([1.0, 1, 0]), BODY, plain(rng), 0.0)
    assert len(faces) == 1
    turned = cuboid(BoxView(0.6, 0.4, 5.0), np.array([-1.0, -1, -1]), np.array([1.0, 1, 0]), BODY, plain(rng), 0.0)
    assert len(turned) == 3


@pytest.mark.parametrize("seed", range(6))
def test_fittings_are_labelled_and_where_they_were_put(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for pieces, part in (
        (bar_handle(rng, FRONT_ON, 0.2, 0.1, 0.3, 0.0, False, plain(rng)), GRIP),
        (knob(rng, FRONT_ON, 0.2, 0.1, 0.05, 0.0, CONTROL, plain(rng)), CONTROL),
    ):
        assert {piece.part for piece in pieces} == {part}
        middle = np.concatenate([piece.outline for piece in pieces]).mean(0)
        assert middle == pytest.approx([0.2, -0.1], abs=0.1)
    assert {piece.part for piece in case(rng, FRONT_ON, 1.0, 1.0, 0.5)[0]} == {BODY}
