"""Sentences as text: politeness away, clauses apart."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from a4agent.offline.clauses import joined_verbs, main_and_purpose, plain, set_apart
from a4agent.offline.knowledge import knowledge, words

VERBS = knowledge().action_index


@pytest.mark.parametrize(
    ("typed", "text"),
    [
        ("Could you please pikc up the mug?", "pick up the mug?"),
        ("I was wondering if you could open the drawer for me", "open the drawer"),
        ("Can I have the fork, please?", "give me the fork?"),
        ("can you open the can", "open the can"),
        ("the part that can cut", "the part that could cut"),
        ("open that can", "open that can"),
        ("the paint can", "the paint can"),
        ("which part of the spatula can support an egg", "which part of the spatula could support an egg"),
        ("take the red and white mug", "take the red mug"),
        ("nimm die tasse", "take the cup"),
        ("turn the knob to the left", "turn the knob"),
        ("Show me where to pull.", "where to pull."),
    ],
)
def test_what_is_only_polite_goes(typed: str, text: str) -> None:
    assert plain(typed) == text


@pytest.mark.parametrize(
    ("text", "wanted", "ruled_out"),
    [
        ("hold the knife, not by the blade", "hold the knife", "not by the blade"),
        ("not the handle, the blade of the knife", "the blade of the knife", "not the handle"),
        ("never touch the blade when you take the saw", "when you take the saw", "never touch the blade "),
        ("take the cup", "take the cup", ""),
    ],
)
def test_what_is_ruled_out(text: str, wanted: str, ruled_out: str) -> None:
    rest, out = set_apart(text)
    assert (rest.rstrip(","), out.strip()) == (wanted, ruled_out.strip())


@pytest.mark.parametrize(
    ("text", "main", "purpose"),
    [
        ("lift the kettle in order to pour tea", "lift the kettle", "in order to pour tea"),
        ("show me where to pull", "show me where to pull", ""),
        ("i need to cut bread", "i need to cut bread", ""),
        ("give it to me", "give it to me", ""),
        ("to cut bread", "to cut bread", ""),
    ],
)
def test_purposes(text: str, main: str, purpose: str) -> None:
    assert main_and_purpose(text) == (main, purpose)


@pytest.mark.parametrize(
    ("spoken", "meant"),
    [
        ("switch the light on.", "switch on the light."),
        ("turn it off", "turn off it"),
        ("throw both doors of the cupboard open", "open both doors of the cupboard"),
        ("pull the old door shut, please", "close the old door, please"),
        ("walk the dog out", "walk the dog out"),
        ("cut the box open with a knife", "cut open the box with a knife"),
    ],
)
def test_verbs_that_are_split(spoken: str, meant: str) -> None:
    assert joined_verbs(spoken, VERBS) == meant


@given(st.text(max_size=200))
def test_text_without_split_verbs_stays_as_it_is(text: str) -> None:
    if not set(words(text)) & {
        "on",
        "off",
        "up",
        "down",
        "in",
        "out",
        "open",
        "shut",
        "closed",
        "away",
        "over",
        "back",
    }:
        assert joined_verbs(text, VERBS) == text
