"""Drawn tools have a grip and a working end."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from a4agent.offline.training.pieces import DrawnThing, Rng
from a4agent.offline.training.tools import TOOLS
from a4agent.offline.vocabulary import GRIP, WORK


@pytest.mark.parametrize("make", TOOLS, ids=lambda make: make.__name__)
def test_tools_have_a_grip_and_a_working_end(make: Callable[[Rng], DrawnThing]) -> None:
    parts = {piece.part for piece in make(np.random.default_rng(0)).pieces}
    assert {GRIP, WORK} <= parts
