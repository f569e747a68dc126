"""`rex-omni-server:URL` against a real HTTP server."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from a4agent.errors import ConfigError, ProviderUnavailable, UnreadableAnswer
from a4agent.experts import registry
from a4agent.experts.rex_omni_answer import FIRST_COORDINATE_ID, SPECIAL_IDS
from a4agent.protocols import DetectRequest
from a4agent.types import Detection
from servers import Call, chat, error

PHOTO = Image.new("RGB", (1998, 999), "white")
REQUEST = DetectRequest(PHOTO, "the handle")
REF, END, OPEN, CLOSE = "<|object_ref_start|>", "<|object_ref_end|>", "<|box_start|>", "<|box_end|>"
BOXES = f"{REF}the handle{END}{OPEN}<0><0><10><20>,<100><200><999><999>{CLOSE}"
POINTS = f"{REF}the handle{END}{OPEN}<5><10>{CLOSE}"
COMMA, WORD = 11, 1820


def ids(*tokens: str | int) -> list[int]:
    """Token ids; plain numbers are coordinates."""
    words = {",": COMMA, "handle": WORD}
    return [FIRST_COORDINATE_ID + t if isinstance(t, int) else SPECIAL_IDS.get(t) or words[t] for t in tokens]


def answers(boxes, points):
    """A server that answers the two questions about an image."""
    return lambda call: boxes if question(call).startswith("Detect") else points


def question(call: Call) -> str:
    return call.json["messages"][-1]["content"][-1]["text"]


def detect(at, /, **settings):
    detector = registry.create(f"rex-omni-server:{at.url}", "detector", {"max_retries": 0, "timeout": 5.0, **settings})
    try:
        return detector.detect([REQUEST])[0]  # type: ignore[attr-defined]
    finally:
        detector.close()


def test_both_questions_are_asked_as_it_was_trained(openai_server):
    openai_server.replies(answers(chat(BOXES, usage=(100, 10, 0)), chat(POINTS, usage=(90, 5, 0))))
    found = detect(openai_server)
    assert isinstance(found, Detection)
    assert np.allclose(found.boxes_xyxy, [[0, 0, 20, 20], [200, 200, 1998, 999]])
    assert np.allclose(found.points_xy, [[10, 10]])
    assert (found.usage.tokens_in, found.usage.tokens_out) == (190, 15)
    assert found.scores is None
    first, second = (call.json for call in openai_server.calls)
    for body in (first, second):
        system, user = body["messages"]
        assert system["content"] == "You are a helpful assistant"
        assert [part["type"] for part in user["content"]] == ["image_url", "text"]
        assert (body["temperature"], body["top_p"], body["top_k"]) == (0.0, 0.05, 1)
        assert (body["repetition_penalty"], body["max_tokens"]) == (1.05, 4096)
        assert body["mm_processor_kwargs"] == {"min_pixels": 12544, "max_pixels": 2007040}
        assert body["skip_special_tokens"] is False
        assert body["return_token_ids"] is True
    assert first["messages"][1]["content"][0] == second["messages"][1]["content"][0]  # the same image, byte for byte
    assert question(openai_server.calls[0]) == (
        "Detect the handle. Output the bounding box coordinates in [x0, y0, x1, y1] format."
    )
    assert question(openai_server.calls[1]) == "Point to the handle."


def test_token_ids_are_trusted_before_the_spelling(openai_server):
    boxes = ids(REF, "handle", END, OPEN, 0, 0, 10, 20, ",", 100, 200, 999, 999, CLOSE)
    openai_server.replies(answers(chat("garbled", token_ids=boxes), chat(POINTS)))
    found = detect(openai_server)
    assert np.allclose(found.boxes_xyxy, [[0, 0, 20, 20], [200, 200, 1998, 999]])
    assert np.allclose(found.points_xy, [[10, 10]])


def test_invalid_token_ids_are_ignored(openai_server):
    openai_server.replies(answers(chat(BOXES, token_ids=[*ids(OPEN, 5, 5, 6, 6, CLOSE), "x"]), chat(POINTS)))
    assert np.allclose(detect(openai_server).boxes_xyxy, [[0, 0, 20, 20], [200, 200, 1998, 999]])


def test_nothing_found_is_a_result(openai_server):
    openai_server.replies(chat(f"{REF}the handle{END}{OPEN}None{CLOSE}"))
    found = detect(openai_server)
    assert isinstance(found, Detection)
    assert found.boxes_xyxy.shape == (0, 4)
    assert found.points_xy.shape == (0, 2)


def test_points_can_be_left_out(openai_server):
    openai_server.replies(chat(BOXES))
    found = detect(openai_server, points=False)
    assert len(openai_server.calls) == 1
    assert len(found.points_xy) == 0


@pytest.mark.parametrize("cut", range(1, 40, 3))
def test_an_answer_cut_off_keeps_its_complete_boxes(openai_server, cut):
    openai_server.replies(chat(BOXES[:-cut], finish_reason="length"))
    found = detect(openai_server, points=False)
    openai_server.replies(chat(BOXES))
    whole = detect(openai_server, points=False)
    assert found.cut_off
    assert len(found.points_xy) == 0
    assert found.boxes_xyxy.tolist() == whole.boxes_xyxy.tolist()[: len(found.boxes_xyxy)]


@pytest.mark.parametrize(
    ("reply", "kind", "words"),
    [
        (chat("(0,0),(10,20)"), UnreadableAnswer, "tokenizer"),
        (chat("", finish_reason="length"), UnreadableAnswer, "tokenizer"),
        (chat(["no text"], token_ids=["x"]), UnreadableAnswer, "tokenizer"),
        (chat(choices=[]), ProviderUnavailable, "choices"),
        (error(503, "loading"), ProviderUnavailable, "loading"),
    ],
)
def test_misbehaviour_is_an_error_for_that_request_alone(openai_server, reply, kind, words):
    openai_server.replies(reply)
    failed = detect(openai_server)
    assert type(failed) is kind
    assert words in str(failed)


def test_the_address_is_the_model(openai_server):
    with pytest.raises(ConfigError, match="after the colon"):
        registry.create("rex-omni-server:", "detector")
    with pytest.raises(ConfigError, match="not a URL"):
        registry.create("rex-omni-server:localhost", "detector")
