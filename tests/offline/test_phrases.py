"""The contract with the detector: what each phrase that the reasoner writes asks for."""

from __future__ import annotations

import pytest

from a4agent.offline.decisions import decide
from a4agent.offline.knowledge import knowledge
from a4agent.offline.phrases import PARTS, Wanted, wanted
from sentence_bank import read


@pytest.mark.parametrize(
    ("phrase", "fields"),
    [
        ("the handle of the black mug", {"part": "grip", "object": "mug", "kind": "mug", "colour": "black"}),
        ("the handle of the left drawer", {"part": "grip", "kind": "drawer", "side": "left", "part_side": None}),
        ("the left handle of the pan", {"part": "grip", "kind": "pan", "side": None, "part_side": "left"}),
        ("the red button of the coffee machine", {"part": "control", "part_colour": "red", "colour": None}),
        ("the blade of the spatula", {"part": "work", "object": "spatula", "kind": "turner"}),
        ("the back of the chair", {"part": "body", "part_side": None}),
        ("the body of the long glass", {"part": "body", "size": "long"}),
        ("the part that can cut", {"part": "work", "object": None, "action": "cut"}),
        ("the part that can contain", {"part": "inside", "action": "contain"}),
        ("the part that can wrap-grasp", {"part": "body", "action": "wrap-grasp"}),
        ("the part of the mug that can contain", {"part": "inside", "kind": "mug", "action": "contain"}),
        ("the small red mug", {"part": "whole", "kind": "mug", "colour": "red", "size": "small"}),
        ("the handle of the frobnicator", {"part": "grip", "object": None, "kind": None}),
        ("the working end of the frobnicator", {"part": "work", "object": None}),
        ("the upper board of the shelf", {"part": "body", "object": "shelf", "part_side": "upper"}),
        ("the left knob", {"part": "control", "kind": "knob", "side": "left"}),
        ("cut the bread", {"part": "work", "object": "knife"}),
    ],
)
def test_what_a_phrase_asks_for(phrase: str, fields: dict[str, str | None]) -> None:
    asked = wanted(phrase)
    assert {name: getattr(asked, name) for name in fields} == fields


def test_every_part_of_every_thing_is_on_a_map() -> None:
    for thing in knowledge().objects.values():
        for part in thing.parts:
            asked = wanted(f"the {part.name} of the {thing.name}")
            assert asked.part in PARTS
            assert asked.object == thing.key


def test_no_phrase_that_the_reasoner_writes_about_a_known_thing_loses_the_thing() -> None:
    for row in read():
        decision = decide(row.sentence, row.seen)
        thing = knowledge().object_named((decision.object_name or "").split(" ")[-1])
        if decision.phrase and thing:
            assert wanted(decision.phrase) != Wanted("whole"), decision.phrase
            assert wanted(decision.phrase).object, decision.phrase
