"""Noun phrases: what they name, which one, whose it is, and in which role."""

from __future__ import annotations

import pytest

from a4agent.offline.knowledge import knowledge
from a4agent.offline.noun_phrases import Noun, nouns


def found(phrase: str, *in_verb: int) -> list[Noun]:
    return nouns(phrase.split(), set(in_verb), knowledge())


@pytest.mark.parametrize(
    ("phrase", "name", "owner"),
    [
        ("the handle of the mug", "handle", "mug"),
        ("the mug's handle", "handle", "mug"),
        ("the mug handle", "handle", "mug"),
        ("the black handle of the big mug", "black handle", "large mug"),
        ("a picture of the mug", "mug", None),
        ("the smaller one of the two mugs", "small mug", None),
        ("the handle", "handle", None),
    ],
)
def test_whose_part_it_is(phrase: str, name: str, owner: str | None) -> None:
    (noun,) = found(phrase)
    assert (noun.name, noun.owner and noun.owner.name) == (name, owner)


@pytest.mark.parametrize(
    ("phrase", "role"),
    [
        ("the mug", "object"),
        ("with the mug", "tool"),
        ("near the mug", "place"),
        ("into the mug", "goal"),
        ("by the mug", "aim"),
    ],
)
def test_the_preposition_gives_the_role(phrase: str, role: str) -> None:
    (noun,) = found(phrase)
    assert noun.role == role


def test_a_side_says_which_one() -> None:
    (drawer,) = found("the drawer on the left")
    assert (drawer.text, drawer.qualifiers) == ("drawer", ("left",))


def test_the_part_is_generic_only_with_an_article() -> None:
    assert found("the part")[0].generic
    assert not found("some part")[0].generic
    assert not found("the mug")[0].generic


def test_one_of_several_keeps_the_preposition() -> None:
    assert [(noun.text, noun.role) for noun in found("on one of the mugs")] == [("mug", "goal")]


def test_a_body_is_no_part_of_a_thing() -> None:
    assert found("in my mouth") == []


def test_the_verb_after_an_unknown_thing_is_not_its_name() -> None:
    part, touches, rod = found("which part of the ferrule touches the rod")
    assert part.owner is not None
    assert (part.owner.text, touches.text, rod.text) == ("ferrule", "touches", "rod")


@pytest.mark.parametrize(("phrase", "generic"), [("the end that cuts", True), ("the end of the bat", False)])
def test_an_end_that_does_something_is_any_part(phrase: str, generic: bool) -> None:
    assert found(phrase, 3)[0].generic == generic


def test_verbs_and_marks_end_a_phrase() -> None:
    assert [noun.text for noun in found("take mug , spoon", 0)] == ["mug", "spoon"]
    assert [noun.text for noun in found("the mug open lid", 2)] == ["mug", "lid"]


def test_unknown_words_are_kept_as_they_are() -> None:
    (noun,) = found("the blue frobnicator")
    assert (noun.text, noun.qualifiers, noun.thing, noun.part) == ("frobnicator", ("blue",), None, None)
