"""The agent: the paper's flow, its ablations, and failures as values."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from a4agent import A4Agent, Given, Region, Target
from a4agent.errors import CredentialError, InputError, ProviderUnavailable
from a4agent.stages.dreamer import Dreamer
from a4agent.stages.spotter import Spotter
from a4agent.stages.thinker import Thinker
from a4agent.testing import ScriptedDetector, ScriptedEditor, ScriptedSegmenter, ScriptedVLM, output, scripted_agent
from a4agent.types import Detection

PHOTO = Image.new("RGB", (64, 48), "grey")


def test_the_three_stages_in_order() -> None:
    heard: list[str] = []
    agent = scripted_agent("the handle of the mug", dream=True)
    affordance = agent.predict(PHOTO, " drink \n", on_stage=lambda name, value: heard.append(name))
    assert heard == ["imagination", "target", "detection", "affordance"]
    assert [(step.stage, step.role) for step in affordance.trace.steps] == [
        ("dreamer", "vlm"),
        ("dreamer", "editor"),
        ("thinker", "vlm"),
        ("spotter", "detector"),
        ("spotter", "segmenter"),
    ]
    assert affordance.status == "ok"
    assert affordance.instruction == "drink"
    assert affordance.imagination is not None
    assert affordance.target is not None
    assert affordance.target.object_part == "the handle of the mug"
    assert agent.spotter.detector.requests[0].phrase == "the handle of the mug"  # type: ignore[attr-defined]
    assert affordance.size_wh == (64, 48)
    assert affordance.mask.sum() == 32 * 24


def test_without_a_dreamer_the_thinker_sees_one_image() -> None:
    agent = scripted_agent()
    agent.predict(PHOTO, "drink")
    assert len(agent.thinker.vlm.requests[0].images) == 1  # type: ignore[union-attr]


def test_the_spotter_alone_takes_the_instruction_as_the_phrase() -> None:
    detector = ScriptedDetector()
    affordance = A4Agent(None, None, Spotter(detector, ScriptedSegmenter())).predict(PHOTO, "the red knob")
    assert detector.requests[0].phrase == "the red knob"
    assert affordance.target is None
    assert affordance.status == "ok"


def test_nothing_found_is_a_result() -> None:
    affordance = A4Agent(None, None, Spotter(ScriptedDetector([[]]), ScriptedSegmenter())).predict(PHOTO, "x")
    assert affordance.status == "empty"
    assert affordance.error is None
    assert affordance.boxes_xyxy.shape == (0, 4)
    assert affordance.points_xy.shape == (0, 2)
    assert affordance.mask.shape == (48, 64)
    assert not affordance.mask.any()


def test_an_unusable_answer_is_status_invalid_and_keeps_what_came_before() -> None:
    vlm = ScriptedVLM(["Edit it.", "no", "no", "no"])
    agent = A4Agent(Dreamer(vlm, ScriptedEditor()), Thinker(vlm), Spotter(ScriptedDetector(), ScriptedSegmenter()))
    affordance = agent.predict(PHOTO, "drink")
    assert affordance.status == "invalid"
    assert "asked 3 times" in (affordance.error or "")
    assert affordance.imagination is not None
    assert len(affordance.trace.steps) == 5


@pytest.mark.parametrize("failure", [ProviderUnavailable("the server is down"), RuntimeError("the server is down")])
def test_a_failed_model_is_status_error_with_its_step(failure: Exception) -> None:
    agent = A4Agent(None, None, Spotter(ScriptedDetector([failure]), ScriptedSegmenter()))
    affordance = agent.predict(PHOTO, "drink")
    assert affordance.status == "error"
    assert "the server is down" in (affordance.error or "")
    assert "the server is down" in affordance.trace.steps[-1].error


def test_what_no_sample_could_survive_is_raised() -> None:
    agent = A4Agent(None, None, Spotter(ScriptedDetector([CredentialError("no key")]), ScriptedSegmenter()))
    with pytest.raises(CredentialError):
        agent.predict(PHOTO, "drink")


@pytest.mark.parametrize("instruction", ["", "  \n", None, 7, "caf\udce9"])
def test_a_blank_or_broken_instruction_is_refused(instruction: Any) -> None:
    with pytest.raises(InputError, match="instruction"):
        scripted_agent().predict(PHOTO, instruction)


@pytest.mark.parametrize("instruction", ["打开冰箱", "ouvre le réfrigérateur", "открой 🧊", 'say "open"', "TASK"])
def test_any_language_reaches_the_model_unchanged(instruction: str) -> None:
    agent = scripted_agent(dream=True)
    agent.predict(PHOTO, instruction)
    assert all(instruction in request.text for request in agent.thinker.vlm.requests)  # type: ignore[union-attr]


def test_images_as_paths_arrays_and_bytes_give_the_same_answer(tmp_path: Path) -> None:
    path = tmp_path / "photo.png"
    PHOTO.save(path)
    agent = scripted_agent()
    for image in (path, str(path), path.read_bytes(), np.asarray(PHOTO)):
        assert agent.predict(image, "drink").mask.sum() == 32 * 24


def test_given_answers_are_not_asked_for() -> None:
    target = Target("drink", "mug", "the rim of the mug")
    agent = scripted_agent(dream=True)
    vlm: Any = agent.thinker.vlm  # type: ignore[union-attr]
    assert agent.predict(PHOTO, "drink", given=Given(target=target)).target == target
    assert not vlm.requests
    box = Detection(np.array([[1, 1, 5, 5]], np.float32))
    assert agent.predict(PHOTO, "drink", given=Given(detection=box)).mask.sum() == 16
    region = Region(None, np.zeros((0, 2), np.float32), np.ones((48, 64), bool))
    assert agent.predict(PHOTO, "drink", given=Given(regions=(region,))).mask.all()
    assert agent.predict(PHOTO, "drink", given=Given(regions=())).status == "empty"
    assert not vlm.requests
    assert len(agent.spotter.detector.requests) == 1  # type: ignore[attr-defined]


def test_with_experts_keeps_shared_models_shared() -> None:
    agent = scripted_agent(dream=True)
    wrapped: list[Any] = []

    def wrap(expert: Any) -> Any:
        wrapped.append(expert)
        return ScriptedVLM([], id=f"wrapped {expert.id}")

    copy = agent.with_experts(wrap)
    assert len(wrapped) == len(agent.experts()) == 4
    assert copy.dreamer is not None
    assert copy.thinker is not None
    assert copy.dreamer.vlm is copy.thinker.vlm
    assert agent.thinker is not None
    assert agent.thinker.vlm is wrapped[0]


def test_closing_the_agent_closes_every_model() -> None:
    with scripted_agent(dream=True) as agent:
        pass
    assert all(expert.closed for expert in agent.experts())  # type: ignore[attr-defined]


def test_the_trace_counts_seconds_and_known_dollars() -> None:
    affordance = scripted_agent(dream=True, seconds=0.01).predict(PHOTO, "drink")
    assert affordance.trace.seconds >= 0.05
    assert affordance.trace.cost == 0.0
    assert all(len(step.prompt_hash) == 16 for step in affordance.trace.steps)
    assert output("x").startswith("### Thinking")
