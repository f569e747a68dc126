"""A thing on its canvas: as large as asked, labelled where it is painted."""

from __future__ import annotations

import numpy as np
import pytest

from a4agent.offline.training import canvas
from a4agent.offline.training.pieces import DrawnThing, Patch, plain, rectangle
from a4agent.offline.vocabulary import GRIP


@pytest.mark.parametrize("fill", [0.3, 0.8])
def test_a_thing_fills_the_share_that_was_asked_for(fill: float) -> None:
    for seed in range(8):
        rng = np.random.default_rng(seed)
        thing = DrawnThing("knife", [Patch(rectangle(0, 0, 1, 0.2), GRIP, plain(rng))])
        at = canvas.place(rng, thing, fill, (0.5, 0.5))
        assert np.ptp(at(thing.pieces[0].outline), axis=0).max() == pytest.approx(fill * canvas.FINE)


def test_labels_are_where_the_thing_is_painted() -> None:
    rng = np.random.default_rng(1)
    image, parts = np.full((canvas.FINE, canvas.FINE, 3), 255, np.float32), np.zeros((canvas.FINE,) * 2, np.uint8)
    thing = DrawnThing("knife", [Patch(rectangle(-50, -20, 50, 20), GRIP, plain(rng))])
    canvas.paint_thing(rng, image, parts, thing, canvas.Placed(np.eye(2), np.full(2, canvas.FINE / 2)), 0.0)
    assert (parts > 0).sum() == pytest.approx(100 * 40, rel=0.05)
    assert (image[parts > 0] != 255).any(1).mean() > 0.95


def test_a_photograph_keeps_its_labels() -> None:
    rng = np.random.default_rng(2)
    parts = np.zeros((canvas.FINE, canvas.FINE), np.uint8)
    parts[100:200, 50:150] = GRIP
    image, small = canvas.expose(rng, canvas.new_canvas(rng)[0], parts)
    assert image.shape == (canvas.SIDE, canvas.SIDE, 3)
    assert image.dtype == small.dtype == np.uint8
    assert (small > 0).mean() == pytest.approx((parts > 0).mean(), rel=0.1)
