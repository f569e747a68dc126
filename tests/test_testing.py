"""The scripted experts keep to the protocols they stand in for."""

from __future__ import annotations

import pytest
from PIL import Image

from a4agent.errors import RateLimited
from a4agent.protocols import ChatAnswer, ChatRequest, EditRequest, Expert, ask
from a4agent.testing import ScriptedDetector, ScriptedEditor, ScriptedSegmenter, ScriptedVLM, scripted_agent

PHOTO = Image.new("RGB", (8, 6))
ASKED = ChatRequest((), "?")


@pytest.mark.parametrize("expert", [ScriptedVLM([]), ScriptedEditor(), ScriptedDetector(), ScriptedSegmenter()])
def test_they_are_experts(expert: object) -> None:
    assert isinstance(expert, Expert)


def test_answers_come_in_order_and_an_error_takes_one_place_of_the_batch() -> None:
    vlm = ScriptedVLM(["a", RateLimited("wait"), ChatAnswer("c")], max_batch=3)
    first, second, third = vlm.chat([ASKED] * 3)
    assert isinstance(first, ChatAnswer)
    assert isinstance(second, RateLimited)
    assert isinstance(third, ChatAnswer)
    assert (first.text, third.text, vlm.batches) == ("a", "c", [3])


def test_an_exhausted_script_raises() -> None:
    with pytest.raises(AssertionError, match="more often than it has answers"):
        ScriptedVLM([]).chat([ASKED])


def test_an_ordinary_exception_is_raised() -> None:
    with pytest.raises(OSError, match="broken"):
        ScriptedEditor([OSError("broken")]).edit([EditRequest(PHOTO, "x")])


def test_ask_finds_the_method_of_a_request() -> None:
    assert ask(ScriptedVLM(["a"]), [ASKED]) != []
    assert ask(ScriptedVLM(["a"]), []) == []


def test_the_scripted_agent_answers() -> None:
    assert scripted_agent("the lid").predict(PHOTO, "open it").target.object_part == "the lid"  # type: ignore[union-attr]
