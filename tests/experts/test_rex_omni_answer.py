"""The reader of Rex-Omni's answers: published vectors, the token path against the text path, and damage."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from a4agent.experts.rex_omni_answer import (
    FIRST_COORDINATE_ID,
    SPECIAL_IDS,
    boxes_and_points,
    detection_prompt,
    pointing_prompt,
    read_answer,
    read_tokens,
)

VECTORS = [
    json.loads(line)
    for line in (Path(__file__).parents[1] / "vectors" / "rex_omni_answers.jsonl").read_text("utf-8").splitlines()
]
WORDS = 1000  # in these tests, a character outside the special vocabulary has the id WORDS + its code point


def encode(text: str) -> list[int]:
    ids: list[int] = []
    for special, number, character in re.findall(r"(<\|[a-z_]+\|>)|<(\d{1,3})>|(.)", text, flags=re.DOTALL):
        ids.append(
            SPECIAL_IDS[special] if special else FIRST_COORDINATE_ID + int(number) if number else WORDS + ord(character)
        )
    return ids


def decode(ids: list[int]) -> str:
    return "".join(chr(i - WORDS) for i in ids)


def by_phrase(shapes):
    found: dict[str, list] = {}
    for phrase, kind, flat in shapes:
        found.setdefault(phrase, []).append((kind, flat))
    return found


def expected_shapes(vector):
    return {
        phrase: [(shape["type"], np.ravel(shape["coords"]).tolist()) for shape in shapes]
        for phrase, shapes in vector["expected"].items()
        if shapes
    }


@pytest.mark.parametrize("vector", VECTORS, ids=range(len(VECTORS)))
@pytest.mark.parametrize("path", ["text", "tokens"])
def test_agrees_with_every_vector(vector, path):
    size_wh = (vector["width"], vector["height"])
    if path == "tokens" and re.search(r"<\d{4,}>", vector["text"]):
        pytest.skip("there is no such coordinate token")
    shapes = (
        read_answer(vector["text"], size_wh) if path == "text" else read_tokens(encode(vector["text"]), size_wh, decode)
    )
    found, expected = by_phrase(shapes), expected_shapes(vector)
    assert list(found) == list(expected)
    for phrase, wanted in expected.items():
        assert [kind for kind, _ in found[phrase]] == [kind for kind, _ in wanted]
        for (_, got), (_, want) in zip(found[phrase], wanted, strict=True):
            assert got == pytest.approx(want, rel=1e-12)


shape = st.lists(st.integers(0, 999), min_size=1, max_size=9)
answer = st.lists(
    st.tuples(st.sampled_from(["mug", "a cup", "it, or not", ""]), st.lists(shape, max_size=4)), max_size=4
)


@given(answer, st.integers(0, 300))
def test_tokens_and_text_read_the_same_wherever_the_answer_is_cut(blocks, cut):
    text = ", ".join(
        f"<|object_ref_start|>{phrase}<|object_ref_end|><|box_start|>"
        + ",".join("".join(f"<{n}>" for n in numbers) for numbers in shapes)
        + "<|box_end|>"
        for phrase, shapes in blocks
    )
    ids = encode(text)
    assert read_tokens(ids, (640, 480), decode) == read_answer(text, (640, 480))
    for _, kind, flat in read_tokens(ids[:cut], (640, 480), decode):
        assert len(flat) % 2 == 0
        assert {2: "point", 4: "box"}.get(len(flat), "polygon") == kind


@given(st.text(alphabet="<>|0123456789box_startendobject_ref, \n", max_size=80))
def test_never_fails_on_garbage(text):
    read_answer("<|object_ref_start|>a<|object_ref_end|><|box_start|>" + text, (640, 480))


def test_a_second_list_without_a_phrase_of_its_own_belongs_to_nobody():
    text = "<|object_ref_start|>a<|object_ref_end|><|box_start|><1><2><|box_end|><|box_start|><3><4><|box_end|>"
    assert [kind for _, kind, _ in read_answer(text, (999, 999))] == ["point"]


def test_boxes_and_points_have_their_shapes_even_when_nothing_was_found():
    boxes, points = boxes_and_points([])
    assert (boxes.shape, points.shape) == ((0, 4), (0, 2))
    shapes = [
        ("a", "polygon", [5.0, 1.0, 2.0, 8.0, 3.0, 3.0]),
        ("a", "point", [1.0, 2.0]),
        ("b", "box", [1.0, 2.0, 3.0, 4.0]),
    ]
    boxes, points = boxes_and_points(shapes)
    assert boxes.tolist() == [[2, 1, 5, 8], [1, 2, 3, 4]]
    assert points.tolist() == [[1, 2]]


def test_prompts_are_the_trained_ones():
    assert detection_prompt("the handle of the mug") == (
        "Detect the handle of the mug. Output the bounding box coordinates in [x0, y0, x1, y1] format."
    )
    assert pointing_prompt("left, upper_knob", "mug") == "Point to left upper knob, mug."


def test_the_reader_needs_no_torch():
    code = "import sys; from a4agent.experts.local.rex_omni import read_answer; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_token_ids_are_those_of_the_published_vocabulary():
    order = ["endoftext", "im_start", "im_end", "object_ref_start", "object_ref_end", "box_start", "box_end"]
    order += ["quad_start", "quad_end", "vision_start", "vision_end", "vision_pad", "image_pad"]
    assert FIRST_COORDINATE_ID == 150643
    assert SPECIAL_IDS.items() <= {f"<|{name}|>": 151643 + k for k, name in enumerate(order)}.items()
    assert SPECIAL_IDS["<|image_pad|>"] == 151655


def test_only_a_comma_ends_a_shape():
    text = "<|object_ref_start|>mug<|object_ref_end|><|box_start|><10> <20>\n<30> <40>, <5> <9><|box_end|>"
    assert read_answer(text, (999, 999)) == [("mug", "box", [10, 20, 30, 40]), ("mug", "point", [5, 9])]
