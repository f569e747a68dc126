"""A key holds everything that changes an answer, and nothing else."""

from __future__ import annotations

import gc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from a4agent.engine.keys import Keys
from a4agent.imaging.load import image_hash
from a4agent.protocols import ChatRequest, DetectRequest, EditRequest, ExpertBase, Prompt, Request, SegmentRequest

RED, BLUE = Image.new("RGB", (4, 3), "red"), Image.new("RGB", (4, 3), "blue")
EXPERT = ExpertBase("x:y", revision="1", settings={"steps": 4})
CHAT = ChatRequest(images=(RED,), text="Where?")
EDIT = EditRequest(image=RED, prompt="open it")
PROMPT = Prompt(np.array([0, 0, 2, 2], np.float32), np.array([[1, 1]], np.float32))
SEGMENT = SegmentRequest(RED, (PROMPT,))
GOLDEN = "371de6cd8c1ef346c0c18e7495e5fe40aff8b7f1b059167c1ef5c2921ac24691"


def key(request: Request, expert: Any = EXPERT) -> str:
    return Keys().of(expert, request)


def test_the_same_question_has_the_same_key_whatever_objects_it_is_made_of() -> None:
    twin = ExpertBase("x:y", revision="1", settings={"steps": 4})
    assert key(CHAT) == key(replace(CHAT, images=(RED.copy(),)), twin)
    assert key(SEGMENT) == key(SegmentRequest(RED.copy(), (replace(PROMPT, points_xy=PROMPT.points_xy.copy()),)))
    assert key(EDIT) == key(replace(EDIT, on_step=print))
    assert len(key(CHAT)) == 64


def test_the_key_is_the_same_in_every_process_and_version() -> None:
    """It names files that other processes and later versions look for."""
    assert key(DetectRequest(RED, "the handle")) == GOLDEN


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (CHAT, replace(CHAT, text="Where")),
        (CHAT, replace(CHAT, images=(BLUE,))),
        (CHAT, replace(CHAT, images=(RED, RED))),
        (replace(CHAT, images=(RED, BLUE)), replace(CHAT, images=(BLUE, RED))),
        (CHAT, replace(CHAT, system="You are")),
        (CHAT, replace(CHAT, schema={"type": "object"})),
        (CHAT, replace(CHAT, max_tokens=7)),
        (CHAT, replace(CHAT, attempt=1)),
        (EDIT, replace(EDIT, seed=1)),
        (EDIT, replace(EDIT, prompt="close it")),
        (EDIT, DetectRequest(RED, "open it")),
        (SEGMENT, SegmentRequest(RED, (PROMPT, PROMPT))),
        (SEGMENT, SegmentRequest(RED, (replace(PROMPT, box_xyxy=None),))),
        (SEGMENT, SegmentRequest(RED, (replace(PROMPT, box_xyxy=np.array([0, 0, 2, 3], np.float32)),))),
        (SEGMENT, SegmentRequest(RED, (replace(PROMPT, points_xy=np.array([[1, 2]], np.float32)),))),
        (SEGMENT, SegmentRequest(RED, (replace(PROMPT, points_xy=np.array([[1], [1]], np.float32)),))),
    ],
)
def test_whatever_is_asked_differently_has_another_key(one: Request, other: Request) -> None:
    assert key(one) != key(other)


@pytest.mark.parametrize(
    "expert",
    [
        ExpertBase("x:z", revision="1", settings={"steps": 4}),
        ExpertBase("x:y", revision="2", settings={"steps": 4}),
        ExpertBase("x:y", revision="1", settings={"steps": 5}),
        ExpertBase("x:y", revision="1", settings={"steps": 4, "dtype": "bfloat16"}),
    ],
)
def test_another_expert_has_another_key(expert: ExpertBase) -> None:
    assert key(CHAT) != key(CHAT, expert)


def test_an_image_is_hashed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    hashed: list[Image.Image] = []
    monkeypatch.setattr("a4agent.engine.keys.image_hash", lambda image: hashed.append(image) or image_hash(image))
    keys, photo = Keys(), RED.copy()
    for request in (ChatRequest((photo,), "a"), DetectRequest(photo, "b"), SegmentRequest(photo, ())):
        keys.of(EXPERT, request)
    assert len(hashed) == 1


def test_images_that_are_gone_are_not_remembered() -> None:
    """Python gives the id of an object that is gone to the next one."""
    keys = Keys()
    seen: set[str] = set()
    for shade in range(200):
        photo = Image.new("RGB", (4, 3), (shade, 0, 0))
        seen.add(keys.of(EXPERT, DetectRequest(photo, "x")))
        del photo
    gc.collect()
    assert len(seen) == 200
    assert not keys._hashes  # pyright: ignore[reportPrivateUsage]
