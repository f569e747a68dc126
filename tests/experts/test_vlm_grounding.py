"""`vlm-grounding:DIALECT`: prompts to the letter, coordinates of the right image, any VLM underneath."""

from __future__ import annotations

import base64
import hashlib
import io
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from a4agent.errors import ConfigError, ProviderUnavailable, TruncatedAnswer, UnknownNameError, UnreadableAnswer
from a4agent.experts import registry
from a4agent.experts.vlm_grounding import create, dialects, smart_resize
from a4agent.protocols import ChatAnswer, DetectRequest, ExpertBase
from a4agent.testing import ScriptedVLM
from a4agent.types import Detection, Usage
from servers import chat, error

PHOTO = Image.new("RGB", (640, 480), "white")
REQUEST = DetectRequest(PHOTO, "The Handle of the mug?")


class Scripted(ExpertBase):
    """A VLM that writes down what it is asked and answers as told."""

    def __init__(self, *answers, **settings):
        super().__init__("scripted:vlm", settings=settings, max_batch=3, concurrency=2)
        self.answers = list(answers)
        self.asked = []
        self.closed = False

    def chat(self, requests):
        self.asked.extend(requests)
        answers = [self.answers.pop(0) for _ in requests]
        return [ChatAnswer(answer) if isinstance(answer, str) else answer for answer in answers]

    def close(self):
        self.closed = True


def detect(dialect, answer, image=PHOTO, **settings):
    vlm = Scripted(answer, **settings)
    found = create(dialect, "detector", vlm=vlm).detect([DetectRequest(image, REQUEST.phrase)])[0]
    return found, vlm.asked[0]


# Digests of the strings that the checkpoints were trained on, with the phrase "the handle": a change is an error.
TRAINED = {
    "affordance-r1": "c2268f46dc5dd772",
    "vision-reasoner": "447512812d160fc6",
    "seg-zero": "d1cdd9a249a8bca4",
}


@pytest.mark.parametrize("name", TRAINED)
def test_trained_prompts_are_to_the_letter(name):
    prompt = dialects()[name].prompt("the handle")
    assert hashlib.sha256(prompt.encode()).hexdigest()[:16] == TRAINED[name]


def test_the_phrase_is_put_in_as_the_dialect_says():
    assert 'answer "what can be held" with' in dialects()["affordance-r1"].prompt('What can be held?"')
    assert "find 'what can be held?' with" in dialects()["seg-zero"].prompt("What can be held?.")
    assert "<ref>What can be held?</ref>" in dialects()["internvl3"].prompt("What can be held?")
    assert dialects()["qwen3-vl"].prompt("{x}").count("{x}") == 2


R1 = (
    "<think> the mug is held <rethink> by its loop </rethink><answer>"
    '[{"bbox_2d": [420, 210, 630, 420], "point_2d": [525, 315], "affordance": "hold"},]</answer>'
)


def test_affordance_r1_answers_in_pixels_of_840_by_840():
    found, asked = detect("affordance-r1", R1)
    assert isinstance(found, Detection)
    assert asked.images[0].size == (840, 840)
    assert asked.max_tokens == 1024
    assert np.array_equal(found.boxes_xyxy, [[320, 120, 480, 240]])
    assert np.array_equal(found.points_xy, [[400, 180]])
    assert found.text == R1
    assert found.scores is None
    assert not found.points_derived


def test_halves_are_rounded_up_as_the_authors_do():
    image = Image.new("RGB", (420, 420))
    found, _ = detect("vision-reasoner", '<answer>[{"bbox_2d": [1, 2, 3, 5], "point_2d": [0, 1]}]</answer>', image)
    assert np.array_equal(found.boxes_xyxy, [[1, 1, 2, 3]])
    assert np.array_equal(found.points_xy, [[0, 1]])


def test_seg_zero_gives_one_box_and_two_points():
    found, _ = detect(
        "seg-zero", "<answer>{'bbox': [0,0,840,840], 'points_1': [84,84], 'points_2': [420,420]}</answer>"
    )
    assert np.array_equal(found.boxes_xyxy, [[0, 0, 640, 480]])
    assert np.array_equal(found.points_xy, [[64, 48], [320, 240]])


def test_qwen25_answers_in_pixels_of_the_size_it_is_sent():
    found, asked = detect("qwen2.5-vl", '```json\n[{"bbox_2d": [0, 0, 644, 476], "label": "handle"}]\n```')
    assert asked.images[0].size == (644, 476)
    assert np.allclose(found.boxes_xyxy, [[0, 0, 640, 480]])


@pytest.mark.parametrize(
    ("dialect", "answer"),
    [
        ("qwen3-vl", '[{"bbox_2d": [500, 250, 1000, 1000], "label": "handle"}]'),
        ("thousandths", '{"thinking": "", "regions": [{"label": "x", "bbox_2d": [500, 250, 1000, 1000]}]}'),
        ("internvl3", "<ref>handle</ref><box>[[500, 250, 1000, 1000]]</box>"),
    ],
)
def test_thousandths_are_of_the_image_whatever_its_size(dialect, answer):
    found, asked = detect(dialect, answer)
    assert asked.images[0].size == PHOTO.size
    assert np.array_equal(found.boxes_xyxy, [[320, 120, 640, 480]])


@given(st.integers(1, 3000), st.integers(1, 3000), st.sampled_from([0, 300, 1007, 2048]), st.sampled_from([0, 90_000]))
def test_the_size_sent_is_one_that_nobody_changes_afterwards(width, height, max_side, max_pixels):
    if max(width, height) > 100 * min(width, height):
        return
    sent = dialects()["qwen2.5-vl"].sent_size((width, height), max_side, max_pixels)
    assert smart_resize(sent, factor=28, min_pixels=56 * 56, max_pixels=16384 * 28 * 28) == sent
    assert not max_side or max(sent) <= max_side
    if min(width, height) >= 28 and max(width, height) < 8 * min(width, height):
        assert not max_pixels or sent[0] * sent[1] <= max_pixels
        assert 0.5 < (sent[0] / sent[1]) / (width / height) < 2


# What `smart_resize` of transformers 5.23 gives for factor 28, 3136 to 1003520 pixels: (w, h) -> (w, h).
PROCESSOR = {
    (640, 480): (644, 476),
    (4000, 3000): (1148, 840),
    (14, 2057): (28, 700),
    (30, 30): (56, 56),
    (28, 28): (56, 56),
    (1001, 1001): (980, 980),
    (1920, 1080): (1316, 728),
    (333, 999): (336, 1008),
}


@pytest.mark.parametrize(("size", "expected"), PROCESSOR.items())
def test_the_resize_rule_is_the_processors(size, expected):
    assert smart_resize(size, factor=28, min_pixels=3136, max_pixels=1003520) == expected


def test_the_resize_rule_agrees_with_transformers_where_it_is_installed():
    module = pytest.importorskip("transformers.models.qwen2_vl.image_processing_pil_qwen2_vl")
    rng = np.random.default_rng(0)
    for width, height in rng.integers(20, 4000, (500, 2)).tolist():
        if max(width, height) <= 200 * min(width, height):
            h, w = module.smart_resize(height, width, 28, 3136, 1003520)
            assert smart_resize((width, height), factor=28, min_pixels=3136, max_pixels=1003520) == (w, h)


def test_a_fixed_size_that_the_vlm_would_shrink_is_refused_at_once():
    with pytest.raises(ConfigError, match="840"):
        create("affordance-r1", "detector", vlm=Scripted(max_side=512))


def test_nothing_found_is_a_result():
    found, _ = detect("affordance-r1", "<think>no mug</think><answer>[]</answer>")
    assert isinstance(found, Detection)
    assert found.boxes_xyxy.shape == (0, 4)
    assert found.points_xy.shape == (0, 2)


def test_one_bad_answer_does_not_spoil_the_batch():
    down = ProviderUnavailable("down")
    vlm = Scripted(R1, "I would hold the handle.", down)
    detector = create("affordance-r1", "detector", vlm=vlm)
    assert (detector.max_batch, detector.concurrency) == (3, 2)
    good, unreadable, failed = detector.detect([REQUEST] * 3)
    assert isinstance(good, Detection)
    assert isinstance(unreadable, UnreadableAnswer)
    assert "I would hold" in str(unreadable)
    assert failed is down
    detector.close()
    assert vlm.closed


def test_an_answer_cut_off_is_read_as_far_as_possible():
    whole = '<answer>[{"bbox_2d": [0, 0, 84, 84], "point_2d": [4, 4]}, {"bbox_2d": [1,'
    found, _ = detect("vision-reasoner", ChatAnswer(whole, finish_reason="length"))
    assert len(found.boxes_xyxy) == 1
    found, _ = detect("vision-reasoner", ChatAnswer("<think> let me see", finish_reason="length"))
    assert isinstance(found, TruncatedAnswer)
    assert "max_tokens" in str(found)


def test_what_the_answer_took_is_passed_on():
    usage = Usage(seconds=1.5, tokens_in=7, cost=0.25, request_id="r")
    found, _ = detect("affordance-r1", ChatAnswer(R1, usage=usage))
    assert found.usage == usage


def test_the_fingerprint_holds_the_vlms():
    one, two = (create("qwen3-vl", "detector", vlm=Scripted(dtype=dtype)) for dtype in ("bf16", "fp32"))
    assert one.fingerprint() != two.fingerprint()


def test_the_fingerprint_holds_the_whole_dialect(monkeypatch):
    known = dialects()["qwen3-vl"]

    def fingerprint(**changes):
        changed = {"qwen3-vl": replace(known, **changes)}
        monkeypatch.setattr("a4agent.experts.vlm_grounding.dialects", lambda: changed)
        return create("qwen3-vl", "detector", vlm=Scripted()).fingerprint()

    assert fingerprint(resize="none") != fingerprint(resize="square 840")
    assert fingerprint(source="here") == fingerprint(source="elsewhere")


def test_over_the_wire_the_image_arrives_in_the_declared_size(openai_server):
    openai_server.replies(error(503, "busy"), chat(R1))
    vlm = {"expert": "openai:hqking/affordance-r1", "base_url": openai_server.url, "max_retries": 0}
    detector = registry.create("vlm-grounding:affordance-r1", "detector", {"vlm": vlm})
    failed, found = detector.detect([REQUEST, REQUEST])  # type: ignore[attr-defined]
    assert isinstance(failed, ProviderUnavailable)
    assert np.array_equal(found.boxes_xyxy, [[320, 120, 480, 240]])
    url = openai_server.calls[1].json["messages"][0]["content"][0]["image_url"]["url"]
    assert Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))).size == (840, 840)
    detector.close()


def test_only_the_dialect_that_explains_json_sends_a_schema():
    for name in dialects():
        vlm = Scripted("[]")
        create(name, "detector", vlm=vlm).detect([REQUEST])
        assert (vlm.asked[0].schema is not None) == (name == "thousandths")


def test_bad_names_and_missing_vlms_are_answered():
    with pytest.raises(UnknownNameError, match="affordance-r1"):
        create("affordance-r2", "detector", vlm=Scripted())
    with pytest.raises(UnknownNameError, match="affordance-r1"):
        registry.inner_experts("vlm-grounding:affordance-r2", {})
    with pytest.raises(ConfigError, match="name one"):
        create("thousandths", "detector")
    with pytest.raises(ConfigError, match="cannot be the vlm"):
        registry.create("vlm-grounding:qwen3-vl", "vlm")


def test_every_dialect_is_declared_in_full():
    for name, dialect in dialects().items():
        assert "{question}" in dialect.question
        assert dialect.coordinates in ("sent", "thousand")
        assert dialect.answer in ("objects", "boxes")
        assert dialect.sent_size((100, 100))
        assert dialect.source
        assert not dialect.vlm or registry.split(dialect.vlm)[0] == "transformers", name
        assert dialect.coordinates != "sent" or dialect.resize != "none", "the size it answers in would be unknown"


def test_geminis_points_have_y_first():
    vlm = ScriptedVLM(['[{"point": [250, 500], "label": "handle", "box_2d": [100, 200, 300, 400]}]'])
    detector = registry.create("vlm-grounding:gemini-er", "detector", {"vlm": vlm})
    found = detector.detect([DetectRequest(Image.new("RGB", (640, 480)), "the handle")])[0]
    assert found.points_xy.tolist() == [[320.0, 120.0]]
    assert found.boxes_xyxy.tolist() == [[128.0, 48.0, 256.0, 144.0]]
