"""The reviewing model: what it is shown, what its answers mean, and answers that mean nothing."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from PIL import Image

from a4agent.errors import UnreadableAnswer
from a4agent.stages.recorder import Recorder
from a4agent.stages.review import Review, read_review
from a4agent.stages.signals import Evidence
from a4agent.stages.spotter import Spotter
from a4agent.testing import ScriptedDetector, ScriptedSegmenter, ScriptedVLM
from a4agent.types import Affordance, Check, Region, Target

PHOTO = Image.new("RGB", (800, 600), "grey")
GOOD = {"thing_there": 1, "right_part": 0.9, "right_count": True, "tight": "yes", "blame": "none", "advice": ""}


def review(*answers: Any) -> tuple[list[Check], Any]:
    mask = np.zeros((600, 800), bool)
    mask[200:300, 400:500] = True
    region = Region(np.array([400, 200, 500, 300], np.float32), np.zeros((0, 2), np.float32), mask)
    target = Target("drink", "mug", "the handle of the mug")
    answer = Affordance("drink from the mug", (800, 600), target=target, regions=(region,), image=PHOTO)
    vlm = ScriptedVLM([text if isinstance(text, str) else json.dumps(text) for text in answers])
    spotter = Spotter(ScriptedDetector(), ScriptedSegmenter())
    return Review().measure(Evidence(answer, spotter, Recorder(), vlm)), vlm.requests


def test_it_is_shown_the_overlay_and_the_place_enlarged() -> None:
    _, (request,) = review(GOOD)
    overlay, crop = request.images
    assert overlay.size == (800, 600)
    assert np.asarray(overlay)[250, 450].tolist() != [128, 128, 128]
    assert crop.size == (200, 200)
    assert len(set(crop.getdata() if not hasattr(crop, "get_flattened_data") else crop.get_flattened_data())) == 1
    assert '"drink from the mug"' in request.text
    assert '"the handle of the mug"' in request.text
    assert request.schema is not None


def test_yes_and_no_are_1_and_0() -> None:
    checks, _ = review(GOOD)
    assert {c.name: c.value for c in checks} == {
        "thing_there": 1.0,
        "right_part": 0.9,
        "right_count": 1.0,
        "tight": 1.0,
    }


def test_the_worst_check_carries_blame_and_advice() -> None:
    checks, _ = review({**GOOD, "right_part": 0.1, "blame": "thinker", "advice": "Name the lid."})
    worst = checks[1]
    assert worst == Check("right_part", 0.1, "Name the lid.", "thinker")
    assert [check.blame for check in checks] == ["thinker", "thinker", "spotter", "spotter"]


@pytest.mark.parametrize("blame", ["none", "", None, "the weather"])
def test_a_blame_that_names_no_stage_falls_to_the_one_at_work(blame: Any) -> None:
    checks, _ = review({**GOOD, "tight": 0, "blame": blame, "advice": None})
    assert checks[3] == Check("tight", 0.0, "the mask follows the outline: 0%", "spotter")


@pytest.mark.parametrize(
    "text", ["", "It looks fine.", "{}", "[1]", '{"thing_there": 2}', json.dumps({**GOOD, "tight": "perhaps"})]
)
def test_an_answer_without_the_json_is_unreadable(text: str) -> None:
    with pytest.raises(UnreadableAnswer, match="not the JSON"):
        read_review(text)


def test_the_last_valid_object_counts() -> None:
    text = f"First: {json.dumps(GOOD)}\nNo, rather ```json\n{json.dumps({**GOOD, 'tight': 0.5})}\n```"
    assert read_review(text).tight == 0.5


def test_blanks_around_blame_and_advice_are_dropped() -> None:
    checks, _ = review({**GOOD, "tight": 0.1, "blame": " thinker\n", "advice": " Look left. "})
    assert [(c.blame, c.note) for c in checks if c.name == "tight"] == [("thinker", "Look left.")]
