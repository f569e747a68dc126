"""Drawn furniture, appliances and switches have something to pull, press or turn."""

from __future__ import annotations

import numpy as np

from a4agent.offline.training.fixtures import FIXTURES
from a4agent.offline.vocabulary import CONTROL, GRIP


def test_most_have_something_to_pull_press_or_turn() -> None:
    asked = {GRIP, CONTROL}
    without = [
        make.__name__ for make in FIXTURES if not asked & {p.part for p in make(np.random.default_rng(1)).pieces}
    ]
    assert set(without) <= {"box", "lamp"}
