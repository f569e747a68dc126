"""Answers as models really write them."""

from __future__ import annotations

import json
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from a4agent.errors import UnreadableAnswer
from a4agent.experts.grounding_answer import Found, read_boxes, read_objects

BOX, POINT = ["bbox_2d", "bbox"], ["point_2d", "points_1", "points_2"]


def read(text: str) -> Found:
    return read_objects(text, box_keys=BOX, point_keys=POINT)


ONE = Found([[10.0, 20.0, 30.0, 40.0]], [[15.0, 25.0]])
READABLE = [
    '[{"bbox_2d": [10, 20, 30, 40], "point_2d": [15, 25]}]',
    '{"bbox_2d": [10, 20, 30, 40], "point_2d": [15, 25]}',
    '<think>t</think><answer>[{"bbox_2d": [10, 20, 30, 40], "point_2d": [15, 25]}]</answer>',
    '<think>never closed <rethink>again</rethink><answer>[{"bbox_2d":[10,20,30,40],"point_2d":[15,25]}]</answer>',
    '<think>[{"bbox_2d": [1, 1, 2, 2]}]</think><answer>[{"bbox_2d":[10,20,30,40],"point_2d":[15,25]}]',
    '<answer></answer><answer>[{"bbox_2d":[10,20,30,40],"point_2d":[15,25]}]</answer>',
    '<answer>{"bbox_2d":[1,2,3<answer>[{"bbox_2d":[10,20,30,40],"point_2d":[15,25]}]</answer>',
    '```json\n[{"bbox_2d": [10, 20, 30, 40], "point_2d": [15, 25]}]\n```',
    '[{"bbox_2d": [10, 20, 30, 40], "point_2d": [15, 25],},]',
    '[{"bbox_2d": "[10, 20, 30, 40]", "point_2d": "15, 25"}]',
    '[{"bbox_2d": ["10", "20", "30", "40"], "point_2d": ["15", "25"]}]',
    "{'bbox': [10, 20, 30, 40], 'points_1': [15, 25]}",
    '[{"bbox_2d": [[10, 20, 30, 40]], "point_2d": [[15, 25]]}]',
    'Sure! Here it is: {"bbox_2d": [10, 20, 30, 40], "point_2d": [15, 25]} I hope it helps.',
    '[{"bbox_2d": [10, 20, 30, 40], "point_2d": [15, 25]}, {"bbox_2d": [50, 60',
    '{"regions": [{"label": "x", "bbox_2d": [10, 20, 30, 40], "point_2d": [15, 25]}]}',
    '{"thinking": "a {brace}", "regions": [{"bbox_2d": [10.0, 2e1, 30, 40], "point_2d": [15, 25]}]}',
    '{"bbox_2d": [10, 20, 30, 40]}\n{"point_2d": [15, 25]}',
    '[{"bbox_2d": [10, 20, 30, 40], "point_2d": [15, 25]}, {"bbox_2d": [1, 2, 3], "point_2d": [NaN, 1]}]',
]


@pytest.mark.parametrize("text", READABLE)
def test_what_is_meant_is_read(text):
    assert read(text) == ONE


NOTHING = [
    "[]",
    "<think>x</think><answer>[]</answer>",
    '{"regions": []}',
    '{"bbox_2d": null, "label": "handle"}',
    '[{"bbox_2d": [], "point_2d": []}]',
    "None",
    "null",
    "There is no handle in this image.",
    "<answer>not found</answer>",
]


@pytest.mark.parametrize("text", NOTHING)
def test_nothing_found_is_empty(text):
    assert read(text) == Found()


@pytest.mark.parametrize(
    "text",
    ["", "The handle is on the left.", '{"label": "handle"}', '{"bbox_2d": [1, 2, 3]}', "<think>[{'bbox': [1,2,3,4]}]"],
)
def test_what_cannot_be_read_is_an_error_that_quotes_it(text):
    with pytest.raises(UnreadableAnswer, match="bbox_2d"):
        read(text)


def test_bare_lists_are_boxes():
    assert read("[[10, 20, 30, 40]]").boxes == [[10.0, 20.0, 30.0, 40.0]]


@pytest.mark.parametrize(
    ("text", "boxes"),
    [
        ("<ref>handle</ref><box>[[100, 200, 300, 400]]</box>", [[100, 200, 300, 400]]),
        ("<box>[[1, 2, 3, 4], [5, 6, 7, 8]]</box>", [[1, 2, 3, 4], [5, 6, 7, 8]]),
        ("handle[[1, 2, 3, 4]]", [[1, 2, 3, 4]]),
        ("The box is [1,2,3,4].", [[1, 2, 3, 4]]),
        ("<box>[[1, 2, 3, 4], [5, 6", [[1, 2, 3, 4]]),
        ("[]", []),
    ],
)
def test_internvl_boxes(text, boxes):
    assert read_boxes(text) == Found([[float(number) for number in box] for box in boxes])


def test_internvl_prose_is_an_error():
    with pytest.raises(UnreadableAnswer, match="four numbers"):
        read_boxes("The handle is at the left.")


numbers = st.floats(0, 1000, allow_nan=False).map(lambda x: round(x, 2))
items = st.fixed_dictionaries(
    {"bbox_2d": st.lists(numbers, min_size=4, max_size=4)},
    optional={
        "point_2d": st.lists(numbers, min_size=2, max_size=2),
        "label": st.text(max_size=8),
    },
)


@given(st.lists(items, min_size=1, max_size=4), st.booleans(), st.booleans())
def test_any_well_formed_answer_comes_back_in_order(answer, tagged, single_quotes):
    text = repr(answer) if single_quotes else json.dumps(answer)
    found = read(f"<think>x</think><answer>{text}</answer>" if tagged else text)
    assert found.boxes == [item["bbox_2d"] for item in answer]
    assert found.points == [item["point_2d"] for item in answer if "point_2d" in item]


@given(st.text(max_size=200) | st.text(alphabet="[]{}<>\"',:0123456789answerbox_2d ", max_size=200))
def test_garbage_is_read_or_refused_but_never_crashes(text):
    for reader in (read, read_boxes):
        try:
            found = reader(text)
        except UnreadableAnswer:
            continue
        assert all(len(box) == 4 for box in found.boxes)
        assert all(len(point) == 2 for point in found.points)


def test_a_box_among_bare_numbers_is_found():
    assert read("[[1, 2, 3, 4], 5, 6, 7]").boxes == [[1, 2, 3, 4]]


@pytest.mark.parametrize(("length", "quoted"), [(200, "x" * 200), (201, "x" * 200 + " ...")])
def test_an_error_quotes_at_most_200_characters(length, quoted):
    with pytest.raises(UnreadableAnswer, match=f"answer '{re.escape(quoted)}'"):
        read("x" * length)
