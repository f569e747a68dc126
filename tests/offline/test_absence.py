"""Two things are named, and one of them is not in the picture."""

from __future__ import annotations

import pytest

from a4agent.offline.decisions import decide


@pytest.mark.parametrize(
    ("instruction", "seen", "unlikely", "phrase"),
    [
        ("drive the nail into the block", (), (), "the head of the hammer"),
        ("drive the nail into the block", ("hammer",), (), "the head of the hammer"),
        ("drive the nail into the block", (), ("hammer",), "the head of the nail"),
        ("drive the nail in with the hammer", (), ("hammer",), "the head of the hammer"),
        ("cut the box open with a knife", ("box",), (), "the lid of the box"),
        ("crack two eggs into the bowl", ("bowl",), (), "the inside of the bowl"),
        ("cut bread", ("mug",), ("knife",), "the blade of the knife"),
        ("scrub the pan with a brush", ("pan",), (), "the surface of the pan"),
        ("scrub the pan with a brush", ("pan", "brush"), (), "the bristles of the brush"),
    ],
)
def test_what_a_missing_tool_is_used_on(
    instruction: str, seen: tuple[str, ...], unlikely: tuple[str, ...], phrase: str
) -> None:
    assert decide(instruction, seen, unlikely=frozenset(unlikely)).phrase == phrase


@pytest.mark.parametrize(
    ("instruction", "seen", "phrase"),
    [
        ("put the cup into the drawer", (), "the handle of the cup"),
        ("put the cup into the drawer", ("drawer", "cup"), "the handle of the cup"),
        ("put the cup into the drawer", ("drawer",), "the surface of the drawer"),
        ("the cups belong in the drawer", ("cup",), "the surface of the drawer"),
        ("toss the wrapper into the trash can", (), "the inside of the trash can"),
        ("put the cup on the upper board of the shelf", (), "the upper board of the shelf"),
        ("put the cup on the upper board of the shelf", ("cup",), "the handle of the cup"),
        ("put the book on one of the boards of the shelf", (), "the boards of the shelf"),
    ],
)
def test_where_something_goes_that_is_not_in_the_picture(instruction: str, seen: tuple[str, ...], phrase: str) -> None:
    assert decide(instruction, seen).phrase == phrase
