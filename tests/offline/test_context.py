"""Questions that name nothing: what was told, or what the picture shows."""

from __future__ import annotations

import pytest

from a4agent.offline.context import about
from a4agent.offline.decisions import decide
from a4agent.offline.knowledge import knowledge
from a4agent.offline.language import read
from a4agent.offline.situation import Situation


def situation(sentence: str, *seen: str) -> Situation:
    reading = read(sentence)
    assert reading is not None
    know = knowledge()
    return Situation(reading, tuple(know.objects[name] for name in seen), know)


@pytest.mark.parametrize(
    ("sentence", "seen", "nouns"),
    [
        ("The socks are put away in here. How do I get at them?", ("drawer",), ["object"]),
        ("The milk has been put back. Where do I pull?", ("refrigerator",), []),
        ("The kettle is hot. Where do I hold it?", ("refrigerator",), ["kettle"]),
        ("The scissors are in the top drawer. Where do I pull?", (), ["drawer"]),
        ("The scissors are in the top drawer. Where do I pull?", ("scissors",), ["scissors"]),
        ("The towels are gone. Where do I pull the drawer?", ("door",), ["towel", "drawer"]),
    ],
)
def test_what_is_only_told_is_left_out(sentence: str, seen: tuple[str, ...], nouns: list[str]) -> None:
    assert [noun.text for noun in about(situation(sentence, *seen)).reading.nouns] == nouns


@pytest.mark.parametrize(
    "sentence",
    ["Open the drawer.", "Which part of the mug do I hold?", "I need to unscrew a bolt. Which tool do I take?"],
)
def test_a_sentence_that_names_what_it_asks_for_stays_as_it_is(sentence: str) -> None:
    whole = situation(sentence, "door")
    assert about(whole) is whole


def test_this_is_not_what_it_covers() -> None:
    told = about(situation("This should cover the box. What do I take it by?", "box"))
    assert told.seen == ()
    assert [noun.text for noun in told.reading.nouns] == ["object"]


@pytest.mark.parametrize(
    ("sentence", "seen", "phrase"),
    [
        ("Get me the cereal from in there.", ("cabinet",), "the handle of the cabinet"),
        ("Grab the sock.", ("drawer",), "the fabric of the sock"),
        ("My lunch is still inside. How do I get it out?", ("microwave",), "the handle of the microwave"),
        ("Someone will tear their sleeve on this. Where do I strike?", (), "the head of the object"),
        ("The crate should stand low down. Where does it go?", (), "the lower shelf of the object"),
        ("Which end picks up peas?", ("fork",), "the tines of the fork"),
        (
            "The drawers are full. I mean the lowest one. Where do I pull?",
            ("drawer",),
            "the handle of the lower drawer",
        ),
        ("Water for the bath is ready. How do I lift it?", ("kettle",), "the handle of the kettle"),
        ("It is locked. Where does the key go?", ("door",), "the lock of the door"),
        ("The cover is held by a screw. What goes into it?", ("screwdriver",), "the shaft of the screwdriver"),
        ("Nothing else holds the wire. Which end bites it?", ("pliers",), "the jaws of the pliers"),
        ("Carry it to the desk. Where do I hold it?", ("lamp",), "the base of the lamp"),
        ("The bread is fresh. What do I cut it with?", ("drawer",), "the blade of the knife"),
        ("My soup is ready. What do I pull?", (), "the handle of the object"),
        ("My hands are muddy. What do I push aside first?", ("drawer",), "the handle of the faucet"),
    ],
)
def test_what_such_questions_are_about(sentence: str, seen: tuple[str, ...], phrase: str) -> None:
    assert decide(sentence, seen).phrase == phrase
