from __future__ import annotations

import base64
import io
import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from a4agent.serve import api_docs, messages
from a4agent.serve.admission import Limits, Refused, to_json
from a4agent.serve.messages import Question, SampleIn, Unusable
from a4agent.types import Affordance, Detection, Imagination, Region, Step, Target, Trace


def affordance(score: float | None = 0.5) -> Affordance:
    mask = np.zeros((20, 30), bool)
    mask[2:6, 4:9] = True
    region = Region(np.array([4, 2, 9, 6], np.float32), np.array([[6.5, 3.5]], np.float32), mask, score)
    imagination = Imagination("a hand", Image.new("RGB", (8, 8), "red"))
    return Affordance("open", (30, 20), imagination, Target("open", "box", "the lid"), (region,))


def pixels(png: str) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(png))))


def test_the_default_form_is_what_the_library_reads() -> None:
    read = Affordance.from_dict(json.loads(to_json(messages.to_wire(affordance()))))
    assert (read.mask == affordance().mask).all()
    assert read.target == affordance().target


def test_the_documented_schema_fits_every_form() -> None:
    for mask in ("rle", "png", "none"):
        for imagination in ("none", "png"):
            messages.AffordanceOut.model_validate(messages.to_wire(affordance(), mask, imagination))
    messages.AffordanceOut.model_validate(messages.to_wire(Affordance("", (0, 0), status="error", error="why"), "png"))


def test_png_masks_and_pictures_are_the_same_pixels() -> None:
    data = messages.to_wire(affordance(), "png", "png")
    assert ((pixels(data["mask"]["png"]) == 255) == affordance().mask).all()
    assert (pixels(data["imagination"]["png"]) == (255, 0, 0)).all()
    assert messages.imagination_to_wire(Imagination("Edit it.", Image.new("CMYK", (4, 4))), "png")["png"]


@pytest.mark.parametrize("score", [float("nan"), float("inf"), -float("inf")])
def test_numbers_that_json_does_not_know_are_null(score: float) -> None:
    assert messages.to_wire(affordance(score))["regions"][0]["score"] is None
    found = Detection(np.zeros((1, 4), np.float32), scores=np.array([score], np.float32))
    assert messages.stage_to_wire("detection", found, "none")["scores"] == [None]
    with pytest.raises(ValueError, match="JSON"):
        to_json({"score": score})


def test_an_event_is_one_line_of_data_whatever_the_words() -> None:
    target = Target("a\nb", "ü", "x\r\n\r\nevent: affordance\ndata: {}", "日本")
    event = messages.event("target", messages.stage_to_wire("target", target, "none"))
    assert event.count(b"\n") == 3
    assert b"\r" not in event
    name, data = event.decode().strip().split("\n")
    assert name == "event: target"
    assert json.loads(data.removeprefix("data: "))["object_part"] == target.object_part


def test_a_detection_without_scores_says_so() -> None:
    found = messages.stage_to_wire("detection", Detection(), "none")
    assert found == {"boxes_xyxy": [], "points_xy": [], "scores": None}


def test_half_a_surrogate_becomes_a_replacement_character() -> None:
    target = Target("open", "box", "the \ud83d lid")
    data = json.loads(to_json(messages.to_wire(replace(affordance(), target=target))))
    assert data["target"]["object_part"] == "the \ufffd lid"
    assert b"\xef\xbf\xbd" in messages.event("target", messages.stage_to_wire("target", target, "none"))


def test_the_mask_of_a_single_region_is_sent_once() -> None:
    data = messages.to_wire(affordance())
    assert data["regions"][0]["mask"] is None
    assert data["mask"]["counts"]
    both = replace(affordance(), regions=affordance().regions * 2)
    assert all(region["mask"] == messages.to_wire(both)["mask"] for region in messages.to_wire(both)["regions"])
    assert messages.to_wire(both, "none")["regions"][1]["mask"] is None


def test_a_short_trace_has_no_prompts() -> None:
    step = Step("thinker", "vlm", "x:y", 0.5, prompt="a long prompt", answer="a long answer")
    traced = replace(affordance(), trace=Trace((step,)))
    assert messages.to_wire(traced)["trace"][0]["prompt"] == "a long prompt"
    (call,) = messages.to_wire(traced, trace="calls")["trace"]
    assert "prompt" not in call
    assert "answer" not in call
    assert call["seconds"] == 0.5
    assert messages.to_wire(traced, trace="none")["trace"] == []


LIMITS = Limits(pixels=10_000, batch=3)
VALUES = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=8) | st.just(api_docs.example()["image"]),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["image", "instruction", "part", "id", "samples", "x"]), inner, max_size=4)
    ),
    max_leaves=8,
)


@given(st.binary(max_size=200) | VALUES.map(lambda value: json.dumps(value).encode()))
def test_whatever_comes_is_a_question_or_a_refusal(body: bytes) -> None:
    try:
        found = messages.from_json(body, LIMITS)
    except Refused as refused:
        assert refused.code in (400, 413, 422)
        assert refused.message
    else:
        assert isinstance(found, Question)


@given(st.binary(max_size=300), st.binary(max_size=40))
def test_no_bytes_break_the_reader_of_pictures(noise: bytes, patch: bytes) -> None:
    whole = base64.b64decode(api_docs.example()["image"])
    for data in (noise, whole[: len(noise)], whole[:20] + patch + whole[20 + len(patch) :]):
        try:
            found = messages.from_form({"instruction": "open"}, {"image": data}, LIMITS)
        except Refused as refused:
            assert refused.code in (413, 422)
        else:
            assert found.picture.mode == "RGB"


def test_the_instruction_is_kept_and_the_part_is_given() -> None:
    body = json.dumps({**api_docs.example(), "part": " the rim ", "id": "7"}).encode()
    question = messages.from_json(body, LIMITS)
    assert (question.instruction, question.id, question.picture.size) == ("drink from the mug", "7", (64, 48))
    assert question.given
    assert question.given.target
    assert question.given.target.object_part == "the rim"


def batch(samples: list[dict[str, str]], limits: Limits) -> list[Question | Unusable]:
    return messages.from_samples([SampleIn(**sample) for sample in samples], limits)


def test_a_batch_keeps_the_place_of_a_picture_that_cannot_be_used() -> None:
    samples = [api_docs.example(), {**api_docs.example(), "image": "AAAA", "id": "bad"}, api_docs.example()]
    first, second, third = batch(samples, LIMITS)
    assert isinstance(first, Question)
    assert isinstance(third, Question)
    assert isinstance(second, Unusable)
    assert (second.id, second.instruction) == ("bad", "drink from the mug")
    assert second.reason.startswith("InputError: image")
    with pytest.raises(Refused, match="at most 3 samples"):
        batch(samples * 2, LIMITS)


def test_many_large_pictures_do_not_add_up_in_a_batch() -> None:
    limits = Limits(pixels=64 * 48, batch=9)
    samples = [api_docs.example()] * 5 + [{**api_docs.example(), "image": "AAAA"}]
    (large,) = batch(samples[:1], Limits(pixels=64 * 48 - 1))
    assert isinstance(large, Unusable)
    assert large.reason == "InputError: image: more than 3071 pixels; send it smaller"
    *fit, over, broken = batch(samples, limits)
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
        ({**api_docs.example(), "instruction": " \t"}, "instruction: it is blank"),
    ],
)
def test_validation_errors_avoid_jargon(body: object, says: str) -> None:
    with pytest.raises(Refused) as caught:
        messages.from_json(json.dumps(body).encode(), LIMITS)
    assert (caught.value.code, caught.value.message) == (422, says)
