"""A table of instructions: `must` hold exactly, `seen` while the rules were written, `held` out from them."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from a4agent.offline.knowledge import knowledge
from a4agent.offline.understanding import understand

TABLE = list(
    csv.DictReader(
        Path(__file__).with_name("instructions.tsv").read_text(encoding="utf-8").splitlines(), delimiter="\t"
    )
)


def rows(which: str) -> list[dict[str, str]]:
    return [row for row in TABLE if row["set"] == which]


def agrees(answer: str, wanted: str) -> bool:
    """The same part of the same object, whatever names are used for them."""
    if not answer or not wanted or answer == wanted:
        return answer == wanted
    know = knowledge()
    (part_a, object_a), (part_b, object_b) = (text.removeprefix("the ").split(" of the ") for text in (answer, wanted))
    thing, other = know.object_named(object_a), know.object_named(object_b)
    if thing is None or thing != other:
        return answer == wanted
    return thing.part_named(part_a) == thing.part_named(part_b) is not None


def test_the_table_is_large() -> None:
    assert len(TABLE) >= 120
    assert len({row["instruction"] for row in TABLE}) == len(TABLE)


@pytest.mark.parametrize("row", rows("must"), ids=lambda row: row["instruction"])
def test_what_must_hold_holds_exactly(row: dict[str, str]) -> None:
    assert understand(row["instruction"]).phrase == row["answer"]


@pytest.mark.parametrize(("which", "least"), [("seen", 1.0), ("held", 0.85)])
def test_accuracy(which: str, least: float) -> None:
    wrong = [
        f"{row['instruction']!r}: {understand(row['instruction']).phrase!r}, not {row['answer']!r}"
        for row in rows(which)
        if not agrees(understand(row["instruction"]).phrase, row["answer"])
    ]
    assert len(wrong) <= (1 - least) * len(rows(which)), "\n".join(wrong)


@pytest.mark.parametrize(
    "instruction", ["abre la botella", "ouvre la porte du frigo", "打开冰箱", "öffne die Flasche mit der Hand", "¿?"]
)
def test_other_languages_are_declined_as_such(instruction: str) -> None:
    decision = understand(instruction)
    assert decision.part_name is None
    assert "English" in decision.because


def test_what_is_not_known_is_said_to_be_unknown() -> None:
    decision = understand("translate this letter")
    assert decision.part_name is None
    assert "I do not know" in decision.because
    assert "'translate this letter'" in decision.because


@pytest.mark.parametrize(
    ("instruction", "phrase"),
    [
        ("grab the fridge by its handle", "the handle of the fridge"),
        ("the frobnicator's thing", ""),
        ("not the handle, but the blade of the knife", "the blade of the knife"),
        ("hold the knife, but not by the blade", "the handle of the knife"),
        ("the spout of the teapot", "the spout of the teapot"),
        ("the door of the microwave", "the door of the microwave"),
        ("the handle of the zorble", "the handle of the zorble"),
    ],
)
def test_a_part_that_is_named_is_honoured(instruction: str, phrase: str) -> None:
    assert understand(instruction).phrase == phrase


@pytest.mark.parametrize(
    ("instruction", "phrase"),
    [
        ("open the hatch", "the handle of the hatch"),
        ("How do I open this?", "the handle of the object"),
        ("turn the whatsit", "the knob of the whatsit"),
        ("push the crawdad aside", "the surface of the crawdad"),
        ("Where do I pull?", "the handle of the object"),
    ],
)
def test_a_thing_that_is_not_known_gets_its_usual_part_and_is_said_to_be_so(instruction: str, phrase: str) -> None:
    decision = understand(instruction)
    assert decision.phrase == phrase
    assert f"I do not know this {decision.object_name}" in decision.because


@pytest.mark.parametrize(
    "instruction",
    ["open the discussion", "open a bank account", "start the meeting", "hold on a second", "pull the other one",
     "frobnicate the zorble", "the the the", "Why is the door open?", "When did the war end?"],
)  # fmt: skip
def test_what_cannot_be_touched_is_still_refused(instruction: str) -> None:
    assert understand(instruction).part_name is None


@pytest.mark.parametrize(
    ("instruction", "because"),
    [
        ("fill the cup", "To fill the cup, its inside is used."),
        ("please turn on the faucet", "To turn on the faucet, its handle is used."),
        ("scoop ice cream with a spoon", "To scoop, the bowl of the spoon is used."),
        ("filling the kettle", "To contain, the body of the kettle is used."),
    ],
)
def test_the_reason_is_in_the_speakers_words(instruction: str, because: str) -> None:
    assert understand(instruction).because == because
