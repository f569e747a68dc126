"""`offline:reasoner`: answers the Dreamer's and the Thinker's prompts from a knowledge base, as a language model would.

    reasoner.chat([ChatRequest(images=(photo,), text='... The task instruction is "drink from the mug". ...')])
    -> '### Thinking\\nTo drink, the handle of the mug is used.\\n### Output\\n{"task": ..., "object_part": ...}'

It reads the task from the paper's templates and from nothing else, and does not look at the images.
What it does not know gets an answer with an empty `object_part`, which no Thinker accepts.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence

from a4agent.errors import A4Error, UnreadableAnswer
from a4agent.offline.revision import revision
from a4agent.offline.understanding import Decision, understand
from a4agent.protocols import ChatAnswer, ChatRequest, ExpertBase

_THINKER_TASK = re.compile(r'The task instruction is "(.*?)"\s*\.\s*(?:\n|$|The first image|Think|\*\*)', re.DOTALL)
_THINKER_TASK_LOOSE = re.compile(r'The task instruction is "(.*)"', re.DOTALL)
_DREAMER_TASK = re.compile(r"The given TASK is:\s*(.*)\Z", re.DOTALL)


class OfflineReasoner(ExpertBase):
    """A VisionLanguageModel made of rules; needs no key, no download and no time."""

    def __init__(self) -> None:
        super().__init__("offline:reasoner", revision=revision())

    def chat(self, requests: Sequence[ChatRequest]) -> list[ChatAnswer | A4Error]:
        return [_answer(request.text) for request in requests]


def _answer(text: str) -> ChatAnswer | A4Error:
    task = dreamer_task(text)
    if task is not None:
        return ChatAnswer(text=edit_prompt(understand(task)))
    task = thinker_task(text)
    if task is not None:
        return ChatAnswer(text=thinker_answer(task, understand(task)))
    return UnreadableAnswer(
        "'offline:reasoner' only answers the Dreamer's and the Thinker's prompts of the set 'paper', "
        f"not {text[:60]!r}; name another model: thinker.vlm = 'openai:gpt-4o'"
    )


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
    if not decision.part_name:
        return (
            "Edit the input image to show a person's hand reaching for the main object, "
            "photorealistic, seamless inpainting, keep others unchanged"
        )
    return (
        f"Edit the input image to show a person's hand at {decision.phrase}, ready to {decision.action}: "
        f"the contact is on the {decision.part_name}, and the {decision.object_name} keeps its shape, "
        "texture and place, photorealistic, seamless inpainting, keep others unchanged"
    )
