"""`rex-omni:NAME_OR_FOLDER`: Rex-Omni in this process, boxes and key points for a phrase.

    rex = RexOmni("IDEA-Research/Rex-Omni", "detector")
    rex.detect([DetectRequest(image=photo, phrase="the handle of the mug")])
        -> [Detection(boxes_xyxy=(n, 4), points_xy=(m, 2), text=both raw answers)]

Detection and pointing of an image are two questions in one batch. Boxes are read from token ids. The weights
are under the IDEA licence 1.0, which is non-commercial. Source: model card of IDEA-Research/Rex-Omni.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from a4agent.errors import A4Error, ConfigError
from a4agent.experts.local.base import QUANTISE, LocalExpert, Stopwatch, place
from a4agent.experts.local.checkpoints import find_checkpoint
from a4agent.experts.local.generation import ChatModel, Generation, Turn
from a4agent.experts.local.rex_tokenizer import load_repaired_processor
from a4agent.experts.rex_omni_answer import (
    MAX_NEW_TOKENS,
    MAX_PIXELS,
    MIN_PIXELS,
    REPETITION_PENALTY,
    SYSTEM,
    boxes_and_points,
    detection_prompt,
    pointing_prompt,
    read_answer,
    read_tokens,
)
from a4agent.protocols import DetectRequest, Role
from a4agent.types import Detection, Usage

__all__ = ["RexOmni", "create", "read_answer"]


class RexOmni(LocalExpert):
    """Asks for boxes and for points at once, and reads the ids of the answers.

    The defaults are its authors' settings (greedy, repetition penalty 1.05).

    Args beyond those of `LocalExpert`:
        max_batch: the most images at once, each asked twice.
        max_new_tokens: the longest answer; a box takes five tokens.
        max_pixels: larger images are scaled down to this area.
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
        max_new_tokens: int = MAX_NEW_TOKENS,
        max_pixels: int = MAX_PIXELS,
    ) -> None:
        if max_new_tokens < 1 or max_pixels < MIN_PIXELS:
            raise ConfigError(
                f"max_new_tokens must be at least 1 and max_pixels at least {MIN_PIXELS}, "
                f"not {max_new_tokens!r} and {max_pixels!r}"
            )
        placement = place(device, dtype, attention, quantisation)
        checkpoint = find_checkpoint(model, kinds=("qwen2_5_vl",), revision=revision)
        settings = {"max_new_tokens": max_new_tokens, "max_pixels": max_pixels}
        super().__init__(f"rex-omni:{model}", checkpoint, placement, settings=settings, max_batch=max_batch)
        self._max_new_tokens = max_new_tokens
        self._max_pixels = max_pixels

    def detect(self, requests: Sequence[DetectRequest]) -> list[Detection | A4Error]:
        """Boxes and points, without scores. Of an answer cut off at the token limit, the complete ones are kept.

        Raises:
            ModelFilesError: the tokenizer is not Rex-Omni's.
        """
        return self._in_batches(requests, self._answer)

    def _load(self) -> None:
        processor = load_repaired_processor(self.checkpoint.folder)
        processor.image_processor.size = {"shortest_edge": MIN_PIXELS, "longest_edge": self._max_pixels}
        self._model = ChatModel.load(self.checkpoint, self.placement, processor)

    def _answer(self, requests: Sequence[DetectRequest]) -> list[Detection | A4Error]:
        watch = Stopwatch()
        turns = [
            Turn((request.image,), prompt(request.phrase), SYSTEM)
            for request in requests
            for prompt in (detection_prompt, pointing_prompt)
        ]
        limits = [self._max_new_tokens] * len(turns)
        found: list[Generation] = self._model.generate(turns, limits, {"repetition_penalty": REPETITION_PENALTY})
        usage = watch.usage(len(requests))
        pairs = zip(found[0::2], found[1::2], strict=True)
        return [self._read(request, *pair, usage) for request, pair in zip(requests, pairs, strict=True)]

    def _read(self, request: DetectRequest, detected: Generation, pointed: Generation, usage: Usage) -> Detection:
        decode = self._model.decode
        boxes, _ = boxes_and_points(read_tokens(detected.ids, request.image.size, decode))
        _, points = boxes_and_points(read_tokens(pointed.ids, request.image.size, decode))
        both = (detected, pointed)
        return Detection(
            boxes_xyxy=boxes,
            points_xy=points,
            text="\n".join(decode(generation.ids, skip_special_tokens=False) for generation in both),
            cut_off=any(generation.finish_reason == "length" for generation in both),
            usage=replace(
                usage,
                tokens_in=detected.tokens_in + pointed.tokens_in,
                tokens_out=len(detected.ids) + len(pointed.ids),
            ),
        )


create = RexOmni
