"""Verbs, noun phrases, what is ruled out and what something is for."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from a4agent.offline.language import Reading, read


def reading(text: str) -> Reading:
    found = read(text)
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("sentence", "verbs"),
    [
        ("can you open the can?", ["open"]),
        ("hammer the nail", ["hammer"]),
        ("the hammer", []),
        ("take the hammer", ["take"]),
        ("scoop sugar", ["scoop"]),
        ("the part that can scoop", ["scoop"]),
        ("the part used for cutting", ["cutting"]),
        ("turn the iron on", ["turn on"]),
    ],
)
def test_verbs_are_told_from_nouns(sentence: str, verbs: list[str]) -> None:
    assert [verb.text for verb in reading(sentence).verbs] == verbs


@pytest.mark.parametrize(
    ("sentence", "names"),
    [
        ("Pick up the big black mug next to the left drawer", ["large black mug", "left drawer"]),
        ("take the mug's handle", ["handle"]),
        ("the yellow-handled hammer", ["yellow hammer"]),
        ("open the old hatch now", ["old hatch"]),
        ("where should I put my hand?", []),
    ],
)
def test_noun_phrases(sentence: str, names: list[str]) -> None:
    assert [noun.name for noun in reading(sentence).nouns] == names


def test_owners_and_roles() -> None:
    handle, tool = reading("turn the handle of the red tap with the pliers").nouns
    assert handle.owner is not None
    assert (handle.text, handle.owner.name, tool.text, tool.role) == ("handle", "red tap", "pliers", "tool")


@pytest.mark.parametrize(
    "sentence",
    [
        "hold the knife, not by the blade",
        "hold the knife without its blade",
        "don't hold the knife by the blade",
    ],
)
def test_what_is_ruled_out_is_set_apart(sentence: str) -> None:
    found = reading(sentence)
    assert [noun.text for noun in found.nouns] == ["knife"]
    assert [noun.text for noun in found.unwanted] == ["blade"]


def test_purposes_come_last() -> None:
    found = reading("so that I can cut the bread, hold the knife")
    assert [(verb.text, verb.purpose) for verb in found.verbs] == [("hold", False), ("cut", True)]


@given(st.text())
def test_any_text_can_be_read(text: str) -> None:
    read(text)
