"""What a sentence is about and where its thing is acted on, in a bank of sentences and one by one."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from a4agent.offline.decisions import decide
from sentence_bank import read, same

INSTRUCTIONS = list(
    csv.DictReader(
        Path(__file__).with_name("instructions.tsv").read_text(encoding="utf-8").splitlines(), delimiter="\t"
    )
)


def test_the_bank_is_large_and_varied() -> None:
    rows = read()
    assert len(rows) >= 400
    assert len({(row.seen, row.sentence) for row in rows}) == len(rows)
    assert len({row.kind for row in rows}) == 18
    assert 0.4 < sum(row.held_out for row in rows) / len(rows) < 0.6


@pytest.mark.parametrize("held_out", [False, True])
def test_the_bank_is_read_as_a_person_would(held_out: bool) -> None:
    rows = [row for row in read() if row.held_out == held_out]
    right = sum(row.right() for row in rows)
    assert right >= 0.9 * len(rows), "see python perf/sentences.py --failures"


def test_the_earlier_instructions_are_still_read() -> None:
    wrong = [
        f"{row['instruction']!r}: {decide(row['instruction']).phrase!r}, not {row['answer']!r}"
        for row in INSTRUCTIONS
        if not (
            same(decide(row["instruction"]).phrase, row["answer"], qualifiers=False)
            if row["answer"]
            else not decide(row["instruction"]).phrase
        )
    ]
    assert len(wrong) <= 0.02 * len(INSTRUCTIONS), "\n".join(wrong)


@pytest.mark.parametrize(
    "row", [row for row in INSTRUCTIONS if row["set"] == "must"], ids=lambda row: row["instruction"]
)
def test_what_must_hold_holds_exactly(row: dict[str, str]) -> None:
    assert decide(row["instruction"]).phrase == row["answer"]


@pytest.mark.parametrize(
    ("instruction", "phrase"),
    [
        ("can you grab the spoon", "the handle of the spoon"),
        ("open the can", "the lid of the can"),
        ("Find the part of the object in the center of the image that can grasp", "the part that can grasp"),
        ("can you open the drawer for me", "the handle of the drawer"),
        ("hang it on a hook", "the handle of the object"),
        ("grab the fridge by its handle", "the handle of the fridge"),
        ("not the handle, but the blade of the knife", "the blade of the knife"),
        ("hold the knife, but not by the blade", "the handle of the knife"),
        ("the spout of the teapot", "the spout of the teapot"),
        ("the handle of the zorble", "the handle of the zorble"),
        ("Pick up the black mug by its handle", "the handle of the black mug"),
        ("Open the top drawer", "the handle of the upper drawer"),
        ("cut the bread with the knife", "the blade of the knife"),
        ("the frobnicator's thing", ""),
        ("open the discussion", ""),
        ("Why is the door open?", ""),
        ("frobnicate the zorble", ""),
    ],
)
def test_one_by_one(instruction: str, phrase: str) -> None:
    assert decide(instruction).phrase == phrase


@pytest.mark.parametrize(
    ("seen", "phrase"),
    [
        ((), "the part that can cut"),
        (("knife",), "the blade of the knife"),
        (("mug", "scissors"), "the blades of the scissors"),
    ],
)
def test_a_sentence_without_a_noun_is_about_what_is_in_the_picture(seen: tuple[str, ...], phrase: str) -> None:
    assert decide("find the part that can cut", seen).phrase == phrase


def test_what_a_part_can_turn_is_not_where_it_is_turned() -> None:
    asked = "find the part of the object that can turn"
    assert decide(asked, ("screwdriver",)).phrase == "the shaft of the screwdriver"
    assert decide(asked, ("faucet",)).phrase == "the handle of the faucet"
    assert decide("turn it", ("screwdriver",)).phrase == "the handle of the screwdriver"


def test_a_thing_that_is_not_in_the_picture_is_named_as_missing() -> None:
    decision = decide("pick up the mug", ("knife",), frozenset(["mug"]))
    assert decision.phrase == "the handle of the mug"
    assert decision.because.endswith("I see no mug: the picture shows a knife.")
    assert not decision.sure
    assert "I see no" not in decide("pick up the mug", ("knife",)).because


@pytest.mark.parametrize(
    ("instruction", "seen", "phrase", "sure"),
    [
        ("which part of the square nut goes around the peg?", (), "the working end of the square nut", False),
        ("put the peg in the hole", (), "the handle of the peg", False),
        ("which end goes down?", ("shovel",), "the blade of the shovel", True),
        ("which part of the argument is weak?", (), "", True),
        ("pull the frill of the zorble", (), "the frill of the zorble", True),
        ("what is the frill of the zorble?", (), "", True),
    ],
)
def test_unknown_parts_and_things(instruction: str, seen: tuple[str, ...], phrase: str, sure: bool) -> None:
    decision = decide(instruction, seen)
    assert (decision.phrase, decision.sure) == (phrase, sure)


@pytest.mark.parametrize("instruction", ["open the hatch", "turn the whatsit", "How do I open this?"])
def test_a_guess_is_told_from_knowledge(instruction: str) -> None:
    decision = decide(instruction)
    assert decision.part_name
    assert not decision.sure
    assert "most things" in decision.because


@pytest.mark.parametrize("instruction", ["translate this letter", "otwórz drzwi", "打开冰箱", "?", "the the the"])
def test_a_refusal_ends_with_an_example_that_works(instruction: str) -> None:
    refusal = decide(instruction)
    assert refusal.phrase == ""
    examples = refusal.because.partition("Try ")[2].split("'")[1::2]
    assert len(examples) == 2
    assert all(decide(example).phrase for example in examples)


@pytest.mark.parametrize(
    ("instruction", "because"),
    [
        ("fill the cup", "To fill the cup, use its inside."),
        ("unscrew the cap with the pliers", "To unscrew, use the jaws of the pliers."),
        ("cut the paper", "To cut, use the blades of a pair of scissors."),
    ],
)
def test_reasons_are_english(instruction: str, because: str) -> None:
    assert decide(instruction).because == because
