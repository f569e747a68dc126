"""The whole agent over HTTP: prompt -> edit -> think -> detect, from one profile, on a server that can misbehave."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from a4agent.agent import A4Agent
from a4agent.config import load_settings
from a4agent.testing import ScriptedSegmenter, output
from servers import Call, FaultyServer, Reply, chat, edited, error

PHOTO = Image.fromarray(np.random.default_rng(0).integers(0, 255, (60, 100, 3), np.uint8))
IMAGINED = Image.new("RGB", (48, 48), "blue")
REGIONS = {"regions": [{"label": "handle", "bbox_2d": [100, 500, 300, 1000], "point_2d": [200, 700]}]}
PRICE = {"input": 1.0, "output": 2.0}


def answer(call: Call) -> Reply:
    """What a capable server says to each stage."""
    if call.path.endswith("/edits"):
        return edited(IMAGINED, {"input_tokens": 10, "output_tokens": 20, "total_tokens": 30})
    text = call.json["messages"][-1]["content"][-1]["text"]
    if "edit" in text.lower():
        return chat("Show a hand gripping the handle of the mug.", request_id="dream")
    if "in thousandths" in text:
        return chat(json.dumps(REGIONS), request_id="spot")
    return chat(output("the handle of the mug"), request_id="think")


@pytest.fixture
def agent(openai_server: FaultyServer):
    vlm = {"expert": "openai:m", "base_url": openai_server.url, "price": PRICE, "max_retries": 0, "timeout": 5.0}
    overrides = {
        "dreamer.vlm": vlm,
        "dreamer.editor": {**vlm, "expert": "openai-images:e"},
        "thinker.vlm": vlm,
        "spotter.detector": {"expert": "vlm-grounding:thousandths", "vlm": vlm},
        "spotter.segmenter": "off",
    }
    built = A4Agent.from_settings(load_settings("api", overrides, environ={}))
    spotter = type(built.spotter)(built.spotter.detector, ScriptedSegmenter())
    with A4Agent(built.dreamer, built.thinker, spotter) as agent:
        yield agent


def pictures(call: Call) -> list[str]:
    return [part["image_url"]["url"] for part in call.json["messages"][-1]["content"] if part["type"] == "image_url"]


def test_from_an_instruction_to_a_region(agent, openai_server):
    openai_server.replies(answer)
    affordance = agent.predict(PHOTO, "drink from the mug")
    assert affordance.status == "ok", affordance.error
    assert affordance.target.object_part == "the handle of the mug"
    assert affordance.imagination.image.size == IMAGINED.size
    assert np.array_equal(affordance.boxes_xyxy, [[10, 30, 30, 60]])
    assert np.array_equal(affordance.points_xy, [[20, 42]])

    steps = [step for step in affordance.trace.steps if step.role != "segmenter"]
    assert [step.request_id for step in steps] == ["dream", "req-2", "think", "spot"]
    chats = 3 * (1000 * 1.0 + 100 * 2.0) / 1e6
    assert affordance.trace.cost == pytest.approx(chats + (10 * 1.0 + 20 * 2.0) / 1e6)


def test_the_original_comes_first_and_as_the_same_bytes_in_every_stage(agent, openai_server):
    openai_server.replies(answer)
    agent.predict(PHOTO, "drink from the mug")
    dream, think, spot = (pictures(call) for call in openai_server.asked())
    assert (len(dream), len(think), len(spot)) == (1, 2, 1)
    assert dream[0] == think[0] == spot[0]
    assert think[1] != think[0]


def test_a_bad_answer_is_asked_for_again_and_both_are_paid_for(agent, openai_server):
    bad = chat("I would hold the handle.", request_id="bad")
    openai_server.replies(answer, answer, bad, answer)
    affordance = agent.predict(PHOTO, "drink from the mug")
    assert affordance.status == "ok", affordance.error
    thinking = [step for step in affordance.trace.steps if step.stage == "thinker"]
    assert [step.request_id for step in thinking] == ["bad", "think"]
    assert all(step.cost for step in thinking)


@pytest.mark.parametrize(
    ("reply", "status"),
    [
        (error(500, "boom"), "error"),
        (chat(None, refusal="no"), "invalid"),
        (Reply(b"<html>", headers={"content-type": "text/html"}), "error"),
        (error(400, "context too long"), "error"),
    ],
)
def test_a_stage_that_fails_is_a_status_and_the_reason(agent, openai_server, reply, status):
    openai_server.replies(reply)
    affordance = agent.predict(PHOTO, "drink from the mug")
    assert affordance.status == status
    assert openai_server.url in affordance.error
    assert affordance.mask.shape == (60, 100)
    assert not affordance.mask.any()
