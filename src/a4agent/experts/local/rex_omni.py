"""`rex-omni:NAME_OR_FOLDER`: Rex-Omni in this process, boxes and key points for a phrase.

    create("IDEA-Research/Rex-Omni", "detector").detect([DetectRequest(image=photo, phrase="the handle of the mug")])
        -> [Detection(boxes_xyxy=(n, 4), points_xy=(m, 2), text=both raw answers)]

Detection and pointing of an image are two questions in one batch. Boxes are read from token ids. The weights
are under the IDEA licence 1.0, which is non-commercial. Source: model card of IDEA-Research/Rex-Omni.
"""

from __future__ import annotations

from collections.abc import Sequence

from a4agent.errors import A4Error, ConfigError
from a4agent.experts.local.base import QUANTISE, LocalExpert, Placement, Stopwatch, place
from a4agent.experts.local.checkpoints import Checkpoint, find_checkpoint
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
from a4agent.types import Detection

__all__ = ["RexOmni", "create", "read_answer"]


def create(
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
) -> RexOmni:
    """Rex-Omni as a detector; the defaults are its authors' settings (greedy, repetition penalty 1.05).

    Args:
        model: a folder, or a name on the hub.
        role: "detector".
        revision: branch, tag or commit.
        device: "auto", a torch device, or "spread" over all GPUs and the CPU.
        dtype: "auto" (bfloat16 on an accelerator, float32 on a CPU), "bfloat16", "float16", "float32".
        attention: "auto" (sdpa), "sdpa", "eager", "flash_attention_2".
        quantisation: "none", "8bit" or "4bit" (bitsandbytes).
        max_batch: the most images at once, each asked twice; halved whenever memory runs out.
        max_new_tokens: the longest answer; a box takes five tokens.
        max_pixels: larger images are scaled down to this area.

    Raises:
        ModelFilesError: no such checkpoint, or the hub cannot be reached.
        ConfigError: a setting has a value it does not take.
    """
    if max_new_tokens < 1 or max_pixels < MIN_PIXELS:
        raise ConfigError(
            f"max_new_tokens must be at least 1 and max_pixels at least {MIN_PIXELS}, "
            f"not {max_new_tokens!r} and {max_pixels!r}"
        )
    placement = place(device, dtype, attention, quantisation)
    checkpoint = find_checkpoint(model, kinds=("qwen2_5_vl",), revision=revision)
    return RexOmni(f"rex-omni:{model}", checkpoint, placement, max_batch, max_new_tokens, max_pixels)


class RexOmni(LocalExpert):
    """Asks for boxes and for points at once, and reads the ids of the answers."""

    shrinking = (QUANTISE,)

    def __init__(
        self,
        id: str,
        checkpoint: Checkpoint,
        placement: Placement,
        max_batch: int = 4,
        max_new_tokens: int = MAX_NEW_TOKENS,
        max_pixels: int = MAX_PIXELS,
    ) -> None:
        settings = {"max_new_tokens": max_new_tokens, "max_pixels": max_pixels}
        super().__init__(id, checkpoint, placement, settings=settings, max_batch=max_batch)
        self._max_new_tokens = max_new_tokens
        self._max_pixels = max_pixels
        self._model: ChatModel | None = None

    def detect(self, requests: Sequence[DetectRequest]) -> list[Detection | A4Error]:
        """Boxes and points, without scores. Of an answer cut off at the token limit, the complete ones are kept.

        Raises:
            ResourceError: the weights do not fit.
            ModelFilesError: the tokenizer is not Rex-Omni's.
            ProviderError: the model failed.
        """
        return self._in_batches(requests, self._answer)

    def _load(self) -> None:
        processor = load_repaired_processor(self.checkpoint.folder)
        processor.image_processor.size = {"shortest_edge": MIN_PIXELS, "longest_edge": self._max_pixels}
        self._model = ChatModel.load(self.checkpoint, self.placement, processor)

    def _unload(self) -> None:
        self._model = None

    def _answer(self, requests: Sequence[DetectRequest]) -> list[Detection | A4Error]:
        assert self._model is not None
        watch = Stopwatch()
        turns = [
            Turn((request.image,), prompt(request.phrase), SYSTEM)
            for request in requests
            for prompt in (detection_prompt, pointing_prompt)
        ]
        generations = self._model.generate(
            turns, [self._max_new_tokens] * len(turns), {"repetition_penalty": REPETITION_PENALTY}
        )
        pairs = zip(generations[0::2], generations[1::2], strict=True)
        return [self._read(request, pair, watch, len(requests)) for request, pair in zip(requests, pairs, strict=True)]

    def _read(
        self, request: DetectRequest, pair: tuple[Generation, Generation], watch: Stopwatch, shared_by: int
    ) -> Detection:
        assert self._model is not None
        text = "\n".join(self._model.decode(generation.ids, skip_special_tokens=False) for generation in pair)
        decode = self._model.decode
        boxes, _ = boxes_and_points(read_tokens(pair[0].ids, request.image.size, decode))
        _, points = boxes_and_points(read_tokens(pair[1].ids, request.image.size, decode))
        return Detection(
            boxes_xyxy=boxes,
            points_xy=points,
            text=text,
            cut_off=any(generation.finish_reason == "length" for generation in pair),
            usage=watch.usage(
                shared_by,
                tokens_in=sum(generation.tokens_in for generation in pair),
                tokens_out=sum(len(generation.ids) for generation in pair),
            ),
        )
