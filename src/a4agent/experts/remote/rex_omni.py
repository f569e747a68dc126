"""`rex-omni-server:URL`: Rex-Omni behind an OpenAI-compatible server, as a detector of boxes and points.

    rex-omni-server:http://127.0.0.1:8000/v1

Serve a folder whose tokenizer was repaired (the coordinate tokens belong at ids 150643 to 151642), with room
for 2560 image tokens and 4096 new ones:

    vllm serve FOLDER --served-model-name IDEA-Research/Rex-Omni --max-model-len 8192 \\
        --mm-processor-kwargs '{"min_pixels": 12544, "max_pixels": 2007040}'

Boxes and points are two questions about one image, sent one after the other: the server reuses the image.
Answers are read from token ids where the server returns them (vLLM), else from the text.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from PIL.Image import Image

from a4agent.errors import A4Error, ConfigError, UnreadableAnswer
from a4agent.experts.remote.base import RemoteExpert, text_of
from a4agent.experts.remote.connection import Connection, Sent
from a4agent.experts.rex_omni_answer import (
    MAX_NEW_TOKENS,
    MAX_PIXELS,
    MIN_PIXELS,
    REPETITION_PENALTY,
    SPECIAL_IDS,
    SYSTEM,
    Shape,
    boxes_and_points,
    detection_prompt,
    pointing_prompt,
    read_answer,
    read_tokens,
)
from a4agent.imaging.encode import PictureEncoder
from a4agent.protocols import DetectRequest, Role
from a4agent.types import Detection, Usage

_EXTRA = {
    "skip_special_tokens": False,
    "return_token_ids": True,
    "top_k": 1,
    "repetition_penalty": REPETITION_PENALTY,
    # Without these, a picture of 2048 x 2048 takes 5,300 tokens of the 8,192.
    "mm_processor_kwargs": {"min_pixels": MIN_PIXELS, "max_pixels": MAX_PIXELS},
}
_BOX = "<|box_start|>"
_COMMA_ID = 11  # "," in the vocabulary of Qwen2.5


class RexOmniServer(RemoteExpert):
    """Rex-Omni over HTTP, by the server's address with "/v1".

    Args beyond those of `RemoteExpert`:
        served_model: the name the server knows the model by.
        points: also ask for key points; False halves the calls.
        max_tokens: the longest answer.
    """

    def __init__(
        self,
        model: str,
        role: Role,
        *,
        served_model: str = "IDEA-Research/Rex-Omni",
        server: str = "vllm",
        api_key_variable: str = "",
        points: bool = True,
        image_format: str = "jpeg",
        max_side: int = 2048,
        quality: int = 95,
        max_tokens: int = MAX_NEW_TOKENS,
        timeout: float = 120.0,
        max_retries: int = 2,
        concurrency: int = 8,
    ) -> None:
        if not model:
            raise ConfigError("write the server's address after the colon: 'rex-omni-server:http://127.0.0.1:8000/v1'")
        if max_tokens < 1:
            raise ConfigError(f"max_tokens must be at least 1, not {max_tokens!r}")
        connection = Connection(served_model, model, server, api_key_variable, timeout, max_retries)
        self._encoder = PictureEncoder(image_format, max_side, quality)
        settings = {"model": served_model, "points": points, "max_tokens": max_tokens, **self._encoder.settings}
        address = f"rex-omni-server:{connection.base_url}"
        free = {"input": 0.0, "output": 0.0}  # a server of your own
        super().__init__(address, connection, settings=settings, concurrency=concurrency, price=free)
        self._points = points
        self._max_tokens = max_tokens

    def detect(self, requests: Sequence[DetectRequest]) -> list[Detection | A4Error]:
        """Two calls a request (boxes, points). Errors that every request would meet are raised."""
        return self._one_by_one(requests, self._detect)

    def _detect(self, request: DetectRequest) -> Detection:
        questions = [detection_prompt(request.phrase)]
        if self._points:
            questions.append(pointing_prompt(request.phrase))
        shapes: list[Shape] = []
        texts: list[str] = []
        usage, cut_off = Usage(attempts=0), False
        for question, kinds in zip(questions, (("box", "polygon"), ("point",)), strict=False):
            read, text, spent, ended_early = self._ask(request.image, question)
            # A box that was cut off after two numbers reads as a point, so an answer gives what it was asked for.
            shapes.extend(shape for shape in read if not ended_early or shape[1] in kinds)
            texts.append(text)
            usage, cut_off = _sum(usage, spent), cut_off or ended_early
        boxes, points = boxes_and_points(shapes)
        return Detection(boxes_xyxy=boxes, points_xy=points, text="\n".join(texts), cut_off=cut_off, usage=usage)

    def _ask(self, image: Image, question: str) -> tuple[list[Shape], str, Usage, bool]:
        content = [
            {"type": "image_url", "image_url": {"url": self._encoder.data_url(image)}},
            {"type": "text", "text": question},
        ]
        completion, sent = self._connection.call(
            lambda client: client.chat.completions.with_raw_response.create(
                model=self._connection.model,
                messages=[{"role": "system", "content": SYSTEM}, {"role": "user", "content": content}],
                temperature=0.0,
                top_p=0.05,
                max_tokens=self._max_tokens,
                extra_body=_EXTRA,
            )
        )
        return self._read(completion, sent, image.size)

    def _read(self, completion: Any, sent: Sent, size_wh: tuple[int, int]) -> tuple[list[Shape], str, Usage, bool]:
        """The shapes, the text, the usage, and whether it ended at the token limit."""
        choice = self._first_choice(completion)
        text = text_of(choice.message.content)
        found: Any = getattr(choice, "token_ids", None)
        ids: list[int] = found if isinstance(found, list) and all(isinstance(token, int) for token in found) else []
        if SPECIAL_IDS[_BOX] in ids:
            shapes = read_tokens(ids, size_wh, _commas)
        elif _BOX in text:
            shapes = read_answer(text, size_wh)
        else:
            raise UnreadableAnswer(
                f"{self._connection} sent no {_BOX}, but {text[:200]!r}: it must keep special tokens and be served "
                "from a folder with the repaired tokenizer"
            )
        return shapes, text, self._usage(completion, sent), choice.finish_reason == "length"


def _commas(ids: list[int]) -> str:
    """Ordinary words as far as reading shapes needs them: commas separate, anything else is a phrase."""
    return "," if _COMMA_ID in ids else "?"


def _sum(one: Usage, two: Usage) -> Usage:
    return Usage(
        seconds=one.seconds + two.seconds,
        attempts=max(one.attempts, two.attempts),
        tokens_in=one.tokens_in + two.tokens_in,
        tokens_out=one.tokens_out + two.tokens_out,
        cost=0.0,
        request_id=" ".join(filter(None, (one.request_id, two.request_id))),
    )


create = RexOmniServer
