"""The declarations: enough of them, readable, and refused where they do not fit."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from a4agent.errors import DataError, UnknownNameError
from a4agent.sim.catalogue import Catalogue, built_in, read_catalogue

COLOURS = "red green blue yellow orange purple black white grey gray brown pink golden silver"
SMALL = """
[package.metaworld]
version = "3.1.1"
licence = "MIT"
folder = "metaworld/assets"

[[thing]]
name = "drawer"
split = "dev"
from = "metaworld"
file = "sawyer_xyz/sawyer_drawer.xml"
root = "drawer"
part.handle = { phrase = "the handle of the drawer", geoms = [{ mesh = "drawerhandle" }] }
task = [
    { say = "Open the drawer.", part = "handle", affordance = "pull" },
    { say = "Where are the socks?", part = "handle", affordance = "pull", direct = false },
]
"""


def test_there_is_enough_to_show() -> None:
    things = built_in().things
    assert len(things) >= 25
    assert len({thing.package for thing in things}) >= 3
    assert {task.direct for thing in things for task in thing.tasks} == {True, False}
    assert sum(task.choose == "any" and len(task.parts) > 1 for thing in things for task in thing.tasks) >= 3
    assert sum(task.choose == "all" and len(task.parts) > 1 for thing in things for task in thing.tasks) >= 2


def test_the_splits_share_no_thing_and_no_sentence() -> None:
    dev, test = built_in().split("dev"), built_in().split("test")
    assert len(dev) >= 8
    assert len(test) >= 8
    assert not {thing.name for thing in dev} & {thing.name for thing in test}
    assert not {task.say for thing in dev for task in thing.tasks} & {
        task.say for thing in test for task in thing.tasks
    }
    assert len(built_in().split(None)) == len(dev) + len(test)


def test_no_sentence_names_a_colour_or_an_id() -> None:
    forbidden = re.compile(rf"\b({'|'.join(COLOURS.split())})\b|_", re.IGNORECASE)
    for thing in built_in().things:
        for text in [*(task.say for task in thing.tasks), *(thing.phrase(task) for task in thing.tasks)]:
            assert not forbidden.search(text), text


def test_a_direct_task_names_its_object_or_part() -> None:
    for thing in built_in().things:
        words = {*thing.name.split(), *re.findall(r"\w+", " ".join(part.phrase for part in thing.parts.values()))}
        content = {word.rstrip("s") for word in words} - {"the", "of", "a", "in", "'"}
        for task in thing.tasks:
            if task.direct:
                said = {word.rstrip("s") for word in re.findall(r"\w+", task.say.lower())}
                assert said & content, task.say


def test_an_indirect_task_does_not_name_its_part() -> None:
    for thing in built_in().things:
        for task in thing.tasks:
            if not task.direct:
                heads = {re.sub(r"^the (.*?)( of .*| in .*)?$", r"\1", thing.parts[part].phrase) for part in task.parts}
                assert not any(re.search(rf"\b{re.escape(head)}\b", task.say.lower()) for head in heads), task.say


def test_a_few_lines_declare_a_thing(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(SMALL)
    catalogue = read_catalogue(tmp_path / "mine.toml")
    assert [thing.name for thing in catalogue.things] == ["drawer"]
    assert catalogue.things[0].kind == "drawer"
    assert catalogue.things[0].phrase(catalogue.things[0].tasks[0]) == "the handle of the drawer"


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("root =", "roots =", "thing.0.roots: Extra inputs"),
        ("root =", "elevation = [60, 10]\nroot =", "thing.0.elevation: Value error, a range goes from low to high"),
        ("root =", "joints = { goal_slidey = [0.0, -0.1] }\nroot =", "thing.0.joints.goal_slidey: Value error"),
        (
            'part = "handle", affordance = "pull" }',
            'part = "knob", affordance = "pull" }',
            "does not declare: ['knob']",
        ),
        ('from = "metaworld"', 'from = "worlds"', "packages that are not declared: ['worlds']"),
        ('geoms = [{ mesh = "drawerhandle" }]', "geoms = [{}]", "a selector needs"),
        ('geoms = [{ mesh = "drawerhandle" }]', "geoms = []", "at least 1"),
        ('split = "dev"', 'split = "train"', "'dev' or 'test'"),
        (
            'part = "handle", affordance = "pull" }',
            'part = ["handle", "handle"], affordance = "pull" }',
            "phrase of its",
        ),
        ("[[thing]]", "[[thing", "mine.toml"),
    ],
)
def test_a_declaration_that_does_not_fit_says_where(tmp_path: Path, old: str, new: str, says: str) -> None:
    assert old in SMALL
    (tmp_path / "mine.toml").write_text(SMALL.replace(old, new, 1))
    with pytest.raises(DataError, match=re.escape(says)):
        read_catalogue(tmp_path / "mine.toml")


def test_a_name_is_declared_once(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(SMALL + SMALL[SMALL.index("[[thing]]") :])
    with pytest.raises(DataError, match="declared twice: \\['drawer'\\]"):
        read_catalogue(tmp_path / "mine.toml")


def test_a_missing_file_is_a_data_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nowhere"):
        read_catalogue(tmp_path / "nowhere.toml")


def test_the_nearest_name_is_suggested() -> None:
    catalogue: Catalogue = built_in()
    with pytest.raises(UnknownNameError, match="did you mean 'microwave'"):
        catalogue.thing("microvawe")
