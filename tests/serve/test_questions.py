from __future__ import annotations

import base64
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from a4agent.serve import openapi, questions
from a4agent.serve.limits import Limits, Refused
from a4agent.serve.questions import Question, Unusable

LIMITS = Limits(pixels=10_000, batch=3)
VALUES = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=8) | st.just(openapi.example()["image"]),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["image", "instruction", "part", "id", "samples", "x"]), inner, max_size=4)
    ),
    max_leaves=8,
)


@given(st.binary(max_size=200) | VALUES.map(lambda value: json.dumps(value).encode()))
def test_whatever_comes_is_a_question_or_a_refusal(body: bytes) -> None:
    for read in (questions.from_json, questions.batch_from_json):
        try:
            found = read(body, LIMITS)
        except Refused as refused:
            assert refused.code in (400, 413, 422)
            assert refused.message
        else:
            assert isinstance(found, Question | list)


@given(st.binary(max_size=300), st.binary(max_size=40))
def test_no_bytes_break_the_reader_of_pictures(noise: bytes, patch: bytes) -> None:
    whole = base64.b64decode(openapi.example()["image"])
    for data in (noise, whole[: len(noise)], whole[:20] + patch + whole[20 + len(patch) :]):
        try:
            found = questions.from_form({"instruction": "open"}, data, LIMITS)
        except Refused as refused:
            assert refused.code in (413, 422)
        else:
            assert found.picture.mode == "RGB"


def test_the_instruction_is_kept_and_the_part_is_given() -> None:
    body = json.dumps({**openapi.example(), "part": " the rim ", "id": "7"}).encode()
    question = questions.from_json(body, LIMITS)
    assert (question.instruction, question.id, question.picture.size) == ("drink from the mug", "7", (64, 48))
    assert question.given
    assert question.given.target
    assert question.given.target.object_part == "the rim"


def test_a_batch_keeps_the_place_of_a_picture_that_cannot_be_used() -> None:
    samples = [openapi.example(), {**openapi.example(), "image": "AAAA", "id": "bad"}, openapi.example()]
    first, second, third = questions.batch_from_json(json.dumps({"samples": samples}).encode(), LIMITS)
    assert isinstance(first, Question)
    assert isinstance(third, Question)
    assert isinstance(second, Unusable)
    assert (second.id, second.instruction) == ("bad", "drink from the mug")
    assert second.reason.startswith("InputError: image")
    with pytest.raises(Refused, match="at most 3 samples"):
        questions.batch_from_json(json.dumps({"samples": samples * 2}).encode(), LIMITS)


def test_many_large_pictures_do_not_add_up_in_a_batch() -> None:
    limits = Limits(pixels=64 * 48, batch=9)
    samples = [openapi.example()] * 5 + [{**openapi.example(), "image": "AAAA"}]
    (large,) = questions.batch_from_json(json.dumps({"samples": samples[:1]}).encode(), Limits(pixels=64 * 48 - 1))
    assert isinstance(large, Unusable)
    assert large.reason == "InputError: image: more than 3071 pixels; send it smaller"
    *fit, over, broken = questions.batch_from_json(json.dumps({"samples": samples}).encode(), limits)
    assert [type(one) for one in fit] == [Question] * 4
    assert isinstance(over, Unusable)
    assert over.reason == (
        "InputError: image: a batch may have 12288 pixels in all; send this picture in another request, or smaller"
    )
    assert isinstance(broken, Unusable)
    assert "not an image" in broken.reason


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ([], "the body: a JSON object is expected"),
        ({**openapi.example(), "instruction": " \t"}, "instruction: it is blank"),
        ({"samples": [3]}, "samples.0: a JSON object is expected"),
    ],
)
def test_what_does_not_fit_is_said_without_jargon(body: object, says: str) -> None:
    read = questions.batch_from_json if "samples" in str(body) else questions.from_json
    with pytest.raises(Refused) as caught:
        read(json.dumps(body).encode(), LIMITS)
    assert (caught.value.code, caught.value.message) == (422, says)
