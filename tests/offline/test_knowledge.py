"""The tables hold together: every name they use is defined, and there is enough of everything."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from a4agent.files import read_package_toml
from a4agent.offline.knowledge import find, knowledge, stem, words
from a4agent.offline.phrases import SHAPES, wanted

TABLE = read_package_toml("a4agent.offline", "knowledge.toml")


def test_there_is_enough_of_everything() -> None:
    assert len(TABLE["objects"]) >= 150
    assert len(TABLE["actions"]) >= 60
    assert sum(1 + len(row.get("also", [])) for row in TABLE["objects"].values()) >= 600


def test_every_name_that_is_used_is_defined() -> None:
    for thing in knowledge().objects.values():
        assert thing.parts, thing.name
        for part in thing.parts:
            assert part.shape in SHAPES, (thing.name, part)
            assert set(part.affords) <= set(TABLE["actions"]), (thing.name, part)
        assert set(thing.uses) <= set(TABLE["actions"]), thing.name
        for action in thing.uses:
            assert thing.part_for(action), f"{thing.name} is used to {action}, but no part of it affords that"


def test_every_object_can_be_taken_or_says_how_it_is_used() -> None:
    for thing in knowledge().objects.values():
        assert any(part.affords for part in thing.parts), thing.name


def test_no_two_objects_have_one_name() -> None:
    names = [name for thing in knowledge().objects.values() for name in {thing.name, *thing.also}]
    assert not {name for name in names if names.count(name) > 1}


@pytest.mark.parametrize(
    ("name", "thing"), [("glasses", "glasses"), ("glass", "glass"), ("tape", "tape"), ("mops", "mop")]
)
def test_names_that_look_alike_are_kept_apart(name: str, thing: str) -> None:
    found = knowledge().object_named(name)
    assert found is not None
    assert found.name == thing


def test_wishes_are_regular_expressions_about_objects_that_help() -> None:
    for wish in knowledge().wishes:
        re.compile(wish.says)
        assert knowledge().objects[wish.object].part_for(wish.action), wish


def test_every_part_of_every_object_is_read_as_its_own_shape() -> None:
    for thing in knowledge().objects.values():
        for part in thing.parts:
            assert wanted(f"the {part.name} of the {thing.name}").shape == part.shape, (thing.name, part.name)


@pytest.mark.parametrize(
    ("one", "other"),
    [("cutting", "cut"), ("slices", "slice"), ("knives", "knife"), ("prying", "pry"), ("tightened", "tighten"),
     ("brushes", "brush"), ("carries", "carry"), ("mixed", "mix"), ("taken", "take"), ("glasses", "glass")],
)  # fmt: skip
def test_endings_do_not_matter(one: str, other: str) -> None:
    assert stem(one) == stem(other)


@pytest.mark.parametrize(("one", "other"), [("glass", "glue"), ("iron", "ironic"), ("bus", "bu"), ("ring", "r")])
def test_different_words_stay_different(one: str, other: str) -> None:
    assert stem(one) != stem(other)


def test_the_longest_name_wins() -> None:
    found = knowledge().find_objects(words("the wine glass beside the glass"))
    assert [mention.value.name for mention in found] == ["wine glass", "glass"]


@given(st.text())
def test_any_text_can_be_searched(text: str) -> None:
    said = words(text)
    for mention in find(said, knowledge().object_index):
        assert 0 <= mention.start < mention.end <= len(said)


def test_phrases_of_unknown_things_degrade() -> None:
    assert wanted("the handle of the frobnicator").shape == "handle"
    assert wanted("the lid of the frobnicator").shape == "top"
    assert wanted("the whatsit of the frobnicator").shape == "whole"
    assert wanted("the frobnicator").shape == "whole"
    assert wanted("the mug").shape == "whole"
    assert wanted("").shape == "whole"
    assert wanted("the left handle of the big red pan").shape == "arm"
    assert wanted("cut the bread").shape == "work"
