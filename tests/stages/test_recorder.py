"""Steps: every call leaves one, also a failed one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from PIL import Image

from a4agent.errors import ProviderError, RateLimited
from a4agent.protocols import ChatAnswer, ChatRequest, DetectRequest, EditRequest, Prompt, Segmentation, SegmentRequest
from a4agent.stages.recorder import Recorder
from a4agent.testing import ScriptedDetector, ScriptedEditor, ScriptedSegmenter, ScriptedVLM
from a4agent.types import Detection, Usage

PHOTO = Image.new("RGB", (8, 6))


def test_a_step_keeps_what_was_asked_answered_and_spent() -> None:
    usage = Usage(seconds=1.5, attempts=2, tokens_in=10, tokens_out=5, cost=0.01, request_id="r1")
    recorder = Recorder()
    recorder.ask("thinker", ScriptedVLM([ChatAnswer("yes", "because", usage=usage)]), ChatRequest((PHOTO,), "well?"))
    (step,) = recorder.trace.steps
    assert (step.stage, step.role, step.expert) == ("thinker", "vlm", "scripted:expert")
    assert (step.prompt, step.answer) == ("well?", "because\n\nyes")
    assert (step.seconds, step.attempts, step.tokens_in, step.tokens_out, step.cost) == (1.5, 2, 10, 5, 0.01)
    assert step.request_id == "r1"


def test_the_prompts_hash_names_the_prompt_and_the_system() -> None:
    recorder = Recorder()
    vlm = ScriptedVLM(lambda request: "ok")
    for text, system in [("a", None), ("a", None), ("b", None), ("a", "s")]:
        recorder.ask("thinker", vlm, ChatRequest((), text, system))
    hashes = [step.prompt_hash for step in recorder.trace.steps]
    assert hashes[0] == hashes[1]
    assert len(set(hashes)) == 3


def test_failures_leave_a_step_and_keep_their_class() -> None:
    recorder = Recorder()
    with pytest.raises(RateLimited):
        recorder.ask("spotter", ScriptedDetector([RateLimited("slow down", 2.0)]), DetectRequest(PHOTO, "x"))
    with pytest.raises(ProviderError, match="scripted:expert failed on a edit request"):
        recorder.ask("dreamer", ScriptedEditor([ValueError("boom")]), EditRequest(PHOTO, "x"))
    assert [step.error.partition(":")[0] for step in recorder.trace.steps] == ["RateLimited", "ValueError"]
    assert all(0 <= step.seconds < 60 for step in recorder.trace.steps)


@pytest.mark.parametrize("answer", [None, Detection(), ChatAnswer(None)])  # type: ignore[arg-type]
def test_an_answer_of_the_wrong_kind_is_the_experts_failure(answer: Any) -> None:
    class Careless(ScriptedVLM):
        def chat(self, requests: Sequence[ChatRequest]) -> list[Any]:
            return [answer]

    recorder = Recorder()
    with pytest.raises(ProviderError, match="scripted:expert failed"):
        recorder.ask("thinker", Careless([]), ChatRequest((), "well?"))
    assert recorder.trace.steps[0].error


def test_images_stay_out_of_the_trace() -> None:
    recorder = Recorder()
    recorder.ask("spotter", ScriptedDetector([Detection(np.ones((2, 4), np.float32))]), DetectRequest(PHOTO, "x"))
    assert recorder.trace.steps[0].answer == "2 boxes, 0 points"


def test_answers_that_end_at_the_token_limit_are_marked() -> None:
    recorder = Recorder()
    vlm = ScriptedVLM([ChatAnswer("half an", finish_reason="length"), ChatAnswer("whole")])
    detector = ScriptedDetector([Detection(cut_off=True), Detection()])
    for _ in range(2):
        recorder.ask("thinker", vlm, ChatRequest((PHOTO,), "well?"))
    for _ in range(2):
        recorder.ask("spotter", detector, DetectRequest(PHOTO, "x"))
    recorder.ask("dreamer", ScriptedEditor(), EditRequest(PHOTO, "x"))
    assert [step.cut_off for step in recorder.trace.steps] == [True, False, True, False, False]


def test_an_edit_is_told_by_its_size() -> None:
    recorder = Recorder()
    recorder.ask("dreamer", ScriptedEditor(), EditRequest(PHOTO, "x"))
    assert recorder.trace.steps[0].answer == "an image of 8 x 6"


def test_an_unusable_answer_is_marked_once() -> None:
    recorder = Recorder()
    recorder.mark(ProviderError("before any call"))
    assert recorder.trace.steps == ()
    recorder.ask("dreamer", ScriptedVLM(["no"]), ChatRequest((PHOTO,), "well?"))
    recorder.mark(RateLimited("first"))
    recorder.mark(ProviderError("second"))
    assert recorder.trace.steps[0].error == "RateLimited: first"


def test_prompts_for_masks_are_kept_to_a_tenth_of_a_pixel() -> None:
    recorder = Recorder()
    answer = Segmentation(np.ones((2, 1, 6, 8), bool), np.array([[0.91234], [0.5]], np.float32))
    prompts = (Prompt(np.array([1.26, 2, 3, 4]), np.array([[2.34, 3]])), Prompt(None, np.array([[5.0, 5.0]])))
    recorder.ask("spotter", ScriptedSegmenter([answer]), SegmentRequest(PHOTO, prompts))
    (step,) = recorder.trace.steps
    assert step.prompt == ("[{'box': [1.3, 2.0, 3.0, 4.0], 'points': [2.3, 3.0]}, {'box': None, 'points': [5.0, 5.0]}]")
    assert step.answer == "2 prompts, predicted IoU [0.912, 0.5]"
