"""The Thinker: its template, its re-asks, its giving up."""

from __future__ import annotations

import pytest
from PIL import Image

from a4agent.errors import TruncatedAnswer, UnreadableAnswer
from a4agent.protocols import ChatAnswer
from a4agent.stages.recorder import Recorder
from a4agent.stages.thinker import Thinker
from a4agent.testing import ScriptedVLM, output
from a4agent.types import Imagination

PHOTO, DREAM = Image.new("RGB", (64, 48)), Image.new("RGB", (32, 32))


def test_with_an_imagination_both_images_go_in_the_original_first() -> None:
    vlm = ScriptedVLM([output("the handle of the mug", "mug", "drink")])
    target = Thinker(vlm).decide(PHOTO, "drink", Imagination("Edit ...", DREAM))
    (request,) = vlm.requests
    assert request.images == (PHOTO, DREAM)
    assert "The second image" in request.text
    assert '"drink"' in request.text
    assert (target.object_part, target.task, target.thinking) == ("the handle of the mug", "drink", "It fits the task.")


def test_without_one_the_template_speaks_of_one_image() -> None:
    vlm = ScriptedVLM([output("the handle of the mug")])
    target = Thinker(vlm).decide(PHOTO, "drink")
    assert vlm.requests[0].images == (PHOTO,)
    assert "second image" not in vlm.requests[0].text
    assert target.task == "drink"


def test_a_bad_answer_is_asked_again_with_the_reason() -> None:
    vlm = ScriptedVLM(["I think the handle.", '{"object_name": "mug"}', output("the handle of the mug")])
    recorder = Recorder()
    assert Thinker(vlm).decide(PHOTO, "drink", recorder=recorder).object_part == "the handle of the mug"
    assert [request.attempt for request in vlm.requests] == [0, 1, 2]
    assert "held no JSON object" in vlm.requests[1].text
    assert "object_part: Field required" in vlm.requests[2].text
    assert vlm.requests[2].text.startswith(vlm.requests[0].text)
    assert [step.stage for step in recorder.trace.steps] == ["thinker"] * 3


def test_after_two_reasks_it_gives_up_with_the_last_reason() -> None:
    vlm = ScriptedVLM(["", "no", "still no"])
    with pytest.raises(UnreadableAnswer, match=r"when asked 3 times: .* \(the answer held no JSON object\)"):
        Thinker(vlm).decide(PHOTO, "drink")
    with pytest.raises(UnreadableAnswer, match="when asked once: the answer was empty"):
        Thinker(ScriptedVLM([""]), reasks=0).decide(PHOTO, "drink")


def test_an_answer_cut_off_by_the_limit_names_the_setting() -> None:
    vlm = ScriptedVLM([ChatAnswer("### Thinking well", finish_reason="length")] * 3)
    with pytest.raises(TruncatedAnswer, match=r"thinker\.max_tokens"):
        Thinker(vlm, max_tokens=16).decide(PHOTO, "drink")


def test_the_servers_reasoning_is_the_thinking_if_the_text_has_none() -> None:
    vlm = ScriptedVLM([ChatAnswer('{"object_name": "mug", "object_part": "the rim"}', reasoning="hot")])
    assert Thinker(vlm).decide(PHOTO, "drink").thinking == "hot"


def test_structured_sends_a_schema_with_thinking_first() -> None:
    vlm = ScriptedVLM([output("the rim")])
    Thinker(vlm, structured=True).decide(PHOTO, "drink")
    schema = vlm.requests[0].schema
    assert schema is not None
    assert next(iter(schema["properties"])) == "thinking"


def test_an_unusable_answer_is_quoted() -> None:
    unknown = "### Thinking\nI see no mug here.\n### Output\n{}"
    with pytest.raises(UnreadableAnswer, match=r"it said 'I see no mug here\.' \(object_name: "):
        Thinker(ScriptedVLM([unknown] * 3)).decide(PHOTO, "drink")


def test_a_rejected_part_comes_back_with_the_reason() -> None:
    vlm = ScriptedVLM([output("the rim"), output("the lid")])
    thinker = Thinker(vlm)
    thinker.decide(PHOTO, "drink")
    assert thinker.decide(PHOTO, "drink", rejected=("the rim", "It is too hot.")).object_part == "the lid"
    first, second = (request.text for request in vlm.requests)
    assert second.startswith(first)
    assert '"the rim"' in second[len(first) :]
    assert "It is too hot." in second[len(first) :]
