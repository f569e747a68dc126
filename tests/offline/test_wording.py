"""Sentences that agree with one thing and with several."""

from __future__ import annotations

import pytest

from a4agent.offline.knowledge import knowledge
from a4agent.offline.wording import held, listed, noun_of, refused, with_article


@pytest.mark.parametrize(
    ("name", "written"),
    [
        ("mug", "a mug"),
        ("iron", "an iron"),
        ("scissors", "a pair of scissors"),
        ("bristles", "bristles"),
        ("glass", "a glass"),
    ],
)
def test_articles(name: str, written: str) -> None:
    assert with_article(name) == written


def test_lists() -> None:
    assert listed(["mug"]) == "a mug"
    assert listed(["mug", "iron", "mug", "saw", "fork"]) == "a mug, an iron and a saw"


@pytest.mark.parametrize(
    ("name", "part", "because"),
    [("mug", "handle", "Hold the mug by its handle."), ("scissors", "handles", "Hold the scissors by their handles.")],
)
def test_reasons_agree(name: str, part: str, because: str) -> None:
    thing = knowledge().objects[name]
    found = thing.part_named(part)
    assert found is not None
    assert held(noun_of(thing), found).because == because


def test_a_long_instruction_is_cut_in_a_refusal() -> None:
    assert len(refused("word " * 100).because) < 240
