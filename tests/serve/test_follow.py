from __future__ import annotations

import threading
import time

import pytest
from PIL import Image

from a4agent.agent import A4Agent
from a4agent.errors import CredentialError
from a4agent.serve.follow import follow
from a4agent.stages.spotter import Spotter
from a4agent.stages.thinker import Thinker
from a4agent.testing import ScriptedDetector, ScriptedSegmenter, ScriptedVLM, output, scripted_agent

PHOTO = Image.new("RGB", (80, 60), "grey")


def test_stages_come_in_their_order() -> None:
    names = [name for name, _ in follow(scripted_agent(dream=True), PHOTO, "open it")]
    assert names == ["imagination", "target", "detection", "affordance"]


def test_a_fatal_error_is_raised_where_it_is_followed() -> None:
    agent = scripted_agent().with_experts(
        lambda expert: (
            ScriptedVLM(lambda request: CredentialError("no key")) if isinstance(expert, ScriptedVLM) else expert
        )
    )
    with pytest.raises(CredentialError):
        list(follow(agent, PHOTO, "open it"))


def test_who_leaves_stops_the_work_at_the_next_stage() -> None:
    detector = ScriptedDetector()
    agent = A4Agent(None, Thinker(ScriptedVLM([output("x")], seconds=0.1)), Spotter(detector, ScriptedSegmenter()))
    stages = follow(agent, PHOTO, "open it")
    assert next(stages)[0] == "target"
    stages.close()
    time.sleep(0.05)
    assert len(detector.requests) <= 1
    assert not any(thread.name == "a4-follow" for thread in threading.enumerate())
