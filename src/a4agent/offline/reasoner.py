"""`offline:reasoner`: answers the Dreamer's and the Thinker's prompts from a knowledge base, as a language model would.

    reasoner.chat([ChatRequest(images=(photo,), text='... The task instruction is "drink from the mug". ...')])
    -> '### Thinking\nThe mug is held by its handle.\n### Output\n{"task": ..., "object_part": ...}'

It reads the task from the paper's templates only; the network reports what the picture shows.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from a4agent.errors import A4Error, RefusedAnswer, UnreadableAnswer
from a4agent.offline import eye, revision
from a4agent.offline.decisions import decide
from a4agent.offline.wording import Decision
from a4agent.protocols import ChatAnswer, ChatRequest, ExpertBase

if TYPE_CHECKING:
    from PIL.Image import Image

_THINKER_TASK = re.compile(r'The task instruction is "(.*?)"\s*\.\s*(?:\n|$|The first image|Think|\*\*)', re.DOTALL)
_THINKER_TASK_LOOSE = re.compile(r'The task instruction is "(.*)"', re.DOTALL)
_DREAMER_TASK = re.compile(r"The given TASK is:\s*(.*)\Z", re.DOTALL)

_NO_KINDS = frozenset(["none", "other"])
RECOGNISED = 0.6
"""From this probability on, a thing in the picture counts as recognised."""
UNLIKELY = 0.1
"""What a tool is used on is meant, and not the tool, if no thing in the picture is one with this probability."""
RULED_OUT = 0.005
"""A kind is missing if no thing in the picture has it with this probability."""


class OfflineReasoner(ExpertBase):
    """A VisionLanguageModel made of rules; needs no key and no download."""

    def __init__(self, *, threads: int = 0) -> None:
        super().__init__("offline:reasoner", revision=revision())
        self.threads = threads

    def chat(self, requests: Sequence[ChatRequest]) -> list[ChatAnswer | A4Error]:
        return [self._answer(request) for request in requests]

    def _answer(self, request: ChatRequest) -> ChatAnswer | A4Error:
        task = dreamer_task(request.text)
        if task is not None:
            return ChatAnswer(text=edit_prompt(decide(task)))
        task = thinker_task(request.text)
        if task is None:
            return UnreadableAnswer(
                "'offline:reasoner' only answers the Dreamer's and the Thinker's prompts of the set 'paper', "
                f"not {request.text[:60]!r}; name another model: thinker.vlm = 'openai:gpt-4o'"
            )
        decision = decide(task, *things_in(request.images[0], self.threads) if request.images else ())
        return ChatAnswer(text=thinker_answer(task, decision)) if decision.phrase else RefusedAnswer(decision.because)


def things_in(image: Image, threads: int = 0) -> tuple[tuple[str, ...], frozenset[str], frozenset[str]]:
    """The kinds of thing recognised in a picture, the likeliest first, those that are missing, and those unlikely."""
    things = eye.look(image, threads)
    likeliest = [thing.likeliest for thing in things]
    seen = tuple(dict.fromkeys(kind for kind, p in likeliest if p >= RECOGNISED and kind not in _NO_KINDS))
    known = {kind for thing in things for kind in thing.kinds} - _NO_KINDS
    most = {kind: max(thing.kinds.get(kind, 0.0) for thing in things) for kind in known}
    missing, unlikely = (frozenset(kind for kind in known if most[kind] < least) for least in (RULED_OUT, UNLIKELY))
    return seen, missing, unlikely


def thinker_task(text: str) -> str | None:
    """The instruction in a Thinker's prompt, None if it is not one."""
    found = _THINKER_TASK.search(text) or _THINKER_TASK_LOOSE.search(text)
    return found[1].strip() if found else None


def dreamer_task(text: str) -> str | None:
    """The instruction at the end of a Dreamer's prompt, None if it is not one."""
    found = _DREAMER_TASK.search(text)
    return found[1].strip().strip('"') if found else None


def thinker_answer(task: str, decision: Decision) -> str:
    """An answer in the form that the Thinker's template asks for."""
    output = {"task": task, "object_name": decision.object_name or "", "object_part": decision.phrase}
    return f"### Thinking\n{decision.because}\n### Output\n{json.dumps(output, indent=4, ensure_ascii=False)}"


def edit_prompt(decision: Decision) -> str:
    """One edit prompt in the form that the Dreamer's template asks for."""
    if not decision.phrase:
        return (
            "Edit the input image to show a person's hand reaching for the main object, "
            "photorealistic, seamless inpainting, keep others unchanged"
        )
    return (
        f"Edit the input image to show a person's hand at {decision.phrase}, ready to {decision.action}: "
        f"the hand touches only that part, and the {decision.object_name} keeps its shape, texture and place, "
        "photorealistic, seamless inpainting, keep others unchanged"
    )
