"""The Dreamer: one prompt written, one picture painted."""

from __future__ import annotations

import pytest
from PIL import Image

from a4agent.errors import RefusedAnswer, TruncatedAnswer, UnreadableAnswer
from a4agent.protocols import ChatAnswer
from a4agent.stages.dreamer import Dreamer
from a4agent.testing import ScriptedEditor, ScriptedVLM

PHOTO, DREAM = Image.new("RGB", (64, 48)), Image.new("RGB", (32, 32))


def test_the_prompt_the_vlm_writes_is_the_prompt_the_editor_gets() -> None:
    vlm, editor = ScriptedVLM(["Edit the input image to show a hand. keep others unchanged"]), ScriptedEditor([DREAM])
    imagination = Dreamer(vlm, editor, seed=7).imagine(PHOTO, "open it")
    assert vlm.requests[0].text.rstrip().endswith("The given TASK is:\nopen it")
    assert vlm.requests[0].images == (PHOTO,)
    assert (
        editor.requests[0].prompt == imagination.prompt == "Edit the input image to show a hand. keep others unchanged"
    )
    assert editor.requests[0].seed == 7
    assert imagination.image is DREAM


@pytest.mark.parametrize(
    "text", ['"Edit it."', "```\nEdit it.\n```", "```text\nEdit it.\n```", "  Edit it.\n", "“Edit it.”"]
)
def test_fences_and_quotes_around_the_prompt_are_dropped(text: str) -> None:
    assert Dreamer(ScriptedVLM([text]), ScriptedEditor()).imagine(PHOTO, "x").prompt == "Edit it."


@pytest.mark.parametrize(
    ("answer", "error"),
    [
        ("", UnreadableAnswer),
        ("``` ```", UnreadableAnswer),
        ("I'm sorry, but I can't help with that.", RefusedAnswer),
        (ChatAnswer("", finish_reason="length"), TruncatedAnswer),
    ],
)
def test_without_a_usable_prompt_nothing_is_painted(answer: object, error: type[Exception]) -> None:
    editor = ScriptedEditor()
    with pytest.raises(error):
        Dreamer(ScriptedVLM([answer]), editor).imagine(PHOTO, "x")
    assert not editor.requests


def test_each_retry_has_a_seed_of_its_own() -> None:
    editor = ScriptedEditor()
    dreamer = Dreamer(ScriptedVLM(lambda request: "Edit it."), editor, seed=7)
    for retry in range(3):
        dreamer.imagine(PHOTO, "open it", retry=retry)
    assert [request.seed for request in editor.requests] == [7, 8, 9]
