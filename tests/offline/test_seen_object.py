"""The parts of a thing that was seen: straight cuts, and only parts that its kind has."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from a4agent.offline.eye import look
from a4agent.offline.vocabulary import GRIP, PARTS, WORK


def test_a_long_thing_is_cut_straight_where_the_maps_change(screwdriver: Callable) -> None:
    """Exchanged maps exchange the ends, and a stray patch of the other label does not fray the cut."""
    (thing, *_) = look(screwdriver().image)
    grip = thing.part("grip", kind="screwdriver")
    exchanged = thing.maps.copy()
    exchanged[[GRIP, WORK]] = exchanged[[WORK, GRIP]]
    assert (replace(thing, maps=exchanged).part("work", kind="screwdriver") == grip).mean() > 0.99
    y, x = np.argwhere(grip).mean(0).astype(int)
    frayed = thing.maps.copy()
    frayed[[GRIP, WORK], y - 2 : y + 2, x - 2 : x + 2] = [[[0.05]], [[0.9]]]
    assert (replace(thing, maps=frayed).part("grip", kind="screwdriver") == grip).mean() > 0.99


def test_a_thing_has_only_the_parts_of_its_kind(screwdriver: Callable) -> None:
    (thing, *_) = look(screwdriver().image)
    assert not thing.part("body", "inside", "lid", kind="knife").any()
    assert not thing.part("work", kind="mug").any()
    assert (thing.part(*PARTS[1:], kind="mug") == thing.shown).all()
