"""What one sentence offers to decide on: tools at hand, tools to reach for, remarks, and what is ruled out."""

from __future__ import annotations

import pytest

from a4agent.offline.knowledge import KnownThing, knowledge
from a4agent.offline.language import read
from a4agent.offline.situation import Situation

KNOW = knowledge()


def situation(sentence: str) -> Situation:
    reading = read(sentence)
    assert reading is not None
    return Situation(reading, (), KNOW)


def thing(name: str) -> KnownThing:
    found = KNOW.object_named(name)
    assert found is not None
    return found


def in_words(found: tuple[KnownThing, str] | None) -> tuple[str, str] | None:
    return found and (found[0].key, found[1])


@pytest.mark.parametrize(
    ("sentence", "has_tool"),
    [
        ("pry the lid off with a screwdriver", True),
        ("pry the lid off with a mug", False),
        ("pry the lid off", False),
    ],
)
def test_only_a_tool_that_can_do_it_counts(sentence: str, has_tool: bool) -> None:
    assert situation(sentence)._has_tool() == has_tool


@pytest.mark.parametrize(
    ("sentence", "tool"),
    [
        ("mop the floor", ("mop", "mop")),
        ("ladle the soup", ("ladle", "scoop")),
        ("scoop sugar", ("spoon", "scoop")),
        ("get the knife and cut bread", ("knife", "cut")),
        ("the soup is cold", ("microwave", "cook")),
        ("get the knife", None),
        ("fill the mug", None),
    ],
)
def test_the_tool_to_reach_for(sentence: str, tool: tuple[str, str] | None) -> None:
    assert in_words(situation(sentence).reached_for()) == tool


def test_a_verb_names_its_tool_only_where_one_usually_takes_it() -> None:
    assert in_words(situation("mop the floor")._named_by_verb()) == ("mop", "mop")
    assert situation("scoop sugar")._named_by_verb() is None
    assert in_words(situation("stir")._by_verb_alone()) == ("wooden spoon", "stir")
    assert situation("get the knife")._by_verb_alone() is None


def test_a_wish_needs_no_verb() -> None:
    assert in_words(situation("the soup is cold").wished()) == ("microwave", "cook")
    assert situation("the mug is blue").wished() is None


@pytest.mark.parametrize(
    ("sentence", "vessel"),
    [("hold my coffee", ("mug", "grasp")), ("hold my mug", None), ("mop the floor", None)],
)
def test_a_drink_is_held_by_its_vessel(sentence: str, vessel: tuple[str, str] | None) -> None:
    assert in_words(situation(sentence)._vessel()) == vessel


@pytest.mark.parametrize(
    ("sentence", "action", "part"),
    [
        ("take the knife", "grasp", "handle"),
        ("take the knife", "cut", "blade"),
        ("take the knife, not by the handle", "grasp", None),
        ("take the knife without cutting yourself", "grasp", "handle"),
        ("take the mug, not by the handle", "grasp", "body"),
        ("take the mug", "cut", None),
    ],
)
def test_the_part_is_one_that_is_not_ruled_out(sentence: str, action: str, part: str | None) -> None:
    found = situation(sentence)._part(thing("knife" if "knife" in sentence else "mug"), action)
    assert (found and found.name) == part


def test_a_remark_comes_after_what_is_asked_for() -> None:
    told = situation("the mug is hot")
    assert [noun.text for noun in told.reading.nouns if told._is_remark(noun)] == ["mug"]
    assert told._states
    asked = situation("fill the mug")
    assert not asked._is_remark(asked.reading.nouns[0])
    assert not asked._states


def test_tools_are_candidates_before_what_is_acted_on() -> None:
    found = situation("open the can with the knife")
    assert found._candidates[0].text == "knife"


def test_what_the_job_is_usually_done_with_names_the_part() -> None:
    job = situation("pry the lid off")
    assert job._part_of_a_usual_tool(job.reading.verbs[0]) == "shaft"
    fetch = situation("get the knife")
    assert fetch._part_of_a_usual_tool(fetch.reading.verbs[0]) is None


def test_the_actions_of_the_verbs() -> None:
    assert situation("get the knife")._wanted_actions == ["grasp"]
    assert situation("fill the mug")._action == "contain"
    assert situation("the mug")._action is None


def test_what_a_part_does_itself_is_no_job_for_a_hand() -> None:
    assert situation("which part of the fork picks up the food?")._wanted_actions == []
    assert situation("which end goes into the screw?")._wanted_actions == []


def test_what_is_pushed_for_a_purpose_serves_it() -> None:
    microwave = thing("microwave")
    assert situation("what do I push?")._part(microwave, "push") == microwave.part_named("door")
    assert situation("what do I push so that it starts?")._part(microwave, "push") == microwave.part_named("buttons")


def test_a_purpose_alone_asks_for_a_tool() -> None:
    assert situation("what do I pull to flush?")._asks_for_a_tool
    assert not situation("what do I pull to open the door?")._asks_for_a_tool
    assert not situation("flush the toilet")._asks_for_a_tool


def test_questions_are_told_from_requests() -> None:
    assert situation("where is the mug?")._asks
    assert not situation("take the mug")._asks
