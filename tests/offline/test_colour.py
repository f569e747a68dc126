"""Colours by the names that people give them."""

from __future__ import annotations

import numpy as np
import pytest

from a4agent.offline.colour import name_of


@pytest.mark.parametrize(
    ("rgb", "name"),
    [((200, 20, 20), "red"), ((20, 40, 200), "blue"), ((15, 15, 15), "black"), ((240, 240, 240), "white"),
     ((30, 150, 40), "green"), ((240, 220, 30), "yellow"), ((110, 60, 30), "brown"), ((128, 128, 128), "grey")],
)  # fmt: skip
def test_plain_names_of_colours(rgb: tuple[int, int, int], name: str) -> None:
    assert name_of(np.array([rgb] * 5, np.uint8)) == name
