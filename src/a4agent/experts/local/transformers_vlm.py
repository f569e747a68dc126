"""`transformers:NAME_OR_FOLDER`: a vision-language model in this process.

Whatever `AutoModelForImageTextToText` loads: Qwen2.5-VL, Qwen3-VL (`Qwen/Qwen3-VL-4B-Instruct`), InternVL3
(`OpenGVLab/InternVL3-8B-hf`) and others.

    vlm = TransformersVlm("Qwen/Qwen2.5-VL-7B-Instruct", "vlm", quantisation="4bit")
    vlm.chat([ChatRequest(images=(photo,), text="...")])
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from PIL.Image import Image

from a4agent.errors import A4Error, ConfigError
from a4agent.experts.local.base import QUANTISE, LocalExpert, Stopwatch, place
from a4agent.experts.local.checkpoints import find_checkpoint
from a4agent.experts.local.generation import ChatModel, Turn
from a4agent.protocols import ChatAnswer, ChatRequest, Role


class TransformersVlm(LocalExpert):
    """A vision-language model of transformers; an answer is the same alone and in a batch, which is padded on the left.

    Args beyond those of `LocalExpert`:
        max_pixels: larger images are scaled down to this area first; the processor's own limits apply after.
        temperature: 0 is greedy.
        template: further arguments of the chat template, such as {enable_thinking = false}, which Qwen3.5 and
            later need to answer without thinking first.
    """

    shrinking = (QUANTISE,)

    def __init__(
        self,
        model: str,
        role: Role,
        *,
        revision: str | None = None,
        device: str = "auto",
        dtype: str = "auto",
        attention: str = "auto",
        quantisation: str = "none",
        max_batch: int = 4,
        max_pixels: int | None = None,
        temperature: float = 0.0,
        template: Mapping[str, Any] | None = None,
    ) -> None:
        if temperature < 0:
            raise ConfigError(f"temperature must be at least 0, not {temperature!r}")
        if max_pixels is not None and max_pixels < 1:
            raise ConfigError(f"max_pixels must be a positive number of pixels, not {max_pixels!r}")
        placement = place(device, dtype, attention, quantisation)
        checkpoint = find_checkpoint(model, revision=revision)
        self._template = dict(template or {})
        settings = {"max_pixels": max_pixels, "temperature": temperature, "template": self._template}
        super().__init__(f"transformers:{model}", checkpoint, placement, settings=settings, max_batch=max_batch)
        self._max_pixels = max_pixels
        self._sampling = {"do_sample": True, "temperature": temperature} if temperature else {}

    def chat(self, requests: Sequence[ChatRequest]) -> list[ChatAnswer | A4Error]:
        """Answer each request; an answer cut off by `max_tokens` has the `finish_reason` "length"."""
        return self._in_batches(requests, self._answer, alike=lambda request: bool(request.images))

    def _load(self) -> None:
        self._model = ChatModel.load(self.checkpoint, self.placement, template=self._template)

    def _answer(self, requests: Sequence[ChatRequest]) -> list[ChatAnswer]:
        watch = Stopwatch()
        turns = [Turn(tuple(map(self._sized, r.images)), r.text, r.system) for r in requests]
        generations = self._model.generate(turns, [r.max_tokens for r in requests], self._sampling)
        answers: list[ChatAnswer] = []
        for generation in generations:
            reasoning, text = split_thinking(self._model.decode(generation.ids).strip())
            usage = watch.usage(len(requests), tokens_in=generation.tokens_in, tokens_out=len(generation.ids))
            answers.append(ChatAnswer(text, reasoning, generation.finish_reason, usage))
        return answers

    def _sized(self, image: Image) -> Image:
        scale = 1.0 if self._max_pixels is None else (self._max_pixels / (image.width * image.height)) ** 0.5
        if scale >= 1.0:
            return image
        return image.resize((max(1, int(image.width * scale)), max(1, int(image.height * scale))))


def split_thinking(text: str) -> tuple[str, str]:
    """The thinking that a model writes before "</think>", and the answer after it; the template may hold "<think>"."""
    thinking, end, answer = text.partition("</think>")
    if not end:
        return "", text
    return thinking.replace("<think>", "", 1).strip(), answer.strip()


create = TransformersVlm
