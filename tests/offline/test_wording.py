"""Split verbs, and noun phrases as far as the rules need them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from a4agent.offline.knowledge import knowledge, words
from a4agent.offline.wording import first_noun, modifiers, noun_from, plain

VERBS = knowledge().action_index


@pytest.mark.parametrize(
    ("spoken", "meant"),
    [
        ("switch the light on.", "switch on the light."),
        ("turn it off", "turn off it"),
        ("throw both doors of the cupboard open", "open both doors of the cupboard"),
        ("pull the old door shut, please", "close the old door, please"),
        ("take the kettle off the stove", "take the kettle off the stove"),
        ("walk the dog out", "walk the dog out"),
        ("cut the box open with a knife", "cut open the box with a knife"),
    ],
)
def test_verbs_that_are_split(spoken: str, meant: str) -> None:
    assert plain(spoken, VERBS) == meant


@given(st.text(max_size=200))
def test_text_without_split_verbs_stays_as_it_is(text: str) -> None:
    if not set(words(text)) & {"on", "off", "up", "down", "in", "out", "open", "shut", "closed", "away", "over"}:
        assert plain(text, VERBS) == text


def test_what_stands_between_the_article_and_a_word() -> None:
    assert modifiers(words("press the big red button"), 4) == ["big", "red"]
    assert modifiers(words("press the button"), 2) == []
    assert modifiers(words("press a button"), 2) is None
    assert modifiers(words("the man with a button"), 4) is None


@pytest.mark.parametrize(
    ("text", "start", "noun"),
    [
        ("open the old hatch now", 1, "old hatch"),
        ("open this", 1, "object"),
        ("open this hatch", 1, "hatch"),
        ("open a hatch", 1, None),
        ("open", 1, None),
        ("lift the lid of the box", 1, "lid"),
    ],
)
def test_noun_phrases(text: str, start: int, noun: str | None) -> None:
    assert noun_from(words(text), start) == noun


def test_the_first_noun_phrase() -> None:
    assert first_noun(words("lift the square nut by its handle")) == "square nut"
    assert first_noun(words("go on")) is None
