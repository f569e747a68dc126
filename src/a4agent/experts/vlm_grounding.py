"""`vlm-grounding:DIALECT`: a vision-language model as detector.

    vlm-grounding:affordance-r1                                          the checkpoint the dialect was written for
    {expert = "vlm-grounding:qwen3-vl", vlm = "transformers:Qwen/Qwen3-VL-4B-Instruct"}
    {expert = "vlm-grounding:thousandths", vlm = {expert = "openai:m", base_url = "http://127.0.0.1:8000/v1"}}

A dialect (dialects.toml) declares the prompt, how the image is resized, the coordinate system of the answer
and the form it has. Any VLM expert can speak it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from PIL.Image import Image, Resampling

from a4agent.errors import A4Error, ConfigError, TruncatedAnswer, UnknownNameError, UnreadableAnswer
from a4agent.experts import registry
from a4agent.experts.coordinates import THOUSAND, CoordinateSystem, resized, to_pixels
from a4agent.experts.grounding_answer import Found, read_boxes, read_objects
from a4agent.files import read_package_toml
from a4agent.protocols import Charges, ChatAnswer, ChatRequest, DetectRequest, ExpertBase, Role, VisionLanguageModel
from a4agent.types import Detection

_REGION_SCHEMA: dict[str, Any] = {
    "type": "object",
    "properties": {
        "label": {"type": "string"},
        "bbox_2d": {"type": "array", "items": {"type": "number"}},
        "point_2d": {"type": "array", "items": {"type": "number"}},
    },
    "required": ["label", "bbox_2d", "point_2d"],
}
_SCHEMA: dict[str, Any] = {
    "type": "object",
    "properties": {"thinking": {"type": "string"}, "regions": {"type": "array", "items": _REGION_SCHEMA}},
    "required": ["thinking", "regions"],
}


@dataclass(frozen=True)
class Dialect:
    """One row of dialects.toml; the fields are explained there."""

    name: str
    vlm: str
    question: str
    lower: bool
    strip: str
    resize: str
    coordinates: str
    answer: str
    box_keys: list[str]
    point_keys: list[str]
    whole_pixels: bool
    max_tokens: int
    schema: bool
    source: str
    order: str = "xy"

    def prompt(self, phrase: str) -> str:
        """The question about a phrase, to the letter."""
        phrase = phrase.lower() if self.lower else phrase
        return self.question.replace("{question}", phrase.strip(self.strip) if self.strip else phrase)

    def sent_size(self, size_wh: tuple[int, int], max_side: int = 0, max_pixels: int = 0) -> tuple[int, int]:
        """The size in which an image of `size_wh` is sent to a VLM that shrinks what exceeds the limits (0: none).

        Raises:
            ConfigError: the dialect's fixed size does not fit the limits.
        """
        rule, *numbers = self.resize.split()
        if rule == "none":
            return size_wh
        if rule == "square":
            side = int(numbers[0])
            if 0 < max_side < side or 0 < max_pixels < side * side:
                raise ConfigError(f"the dialect {self.name!r} sends images of {side} x {side}; its vlm shrinks them")
            return side, side
        factor, least, most = map(int, numbers)
        width, height = size_wh
        if max_side:
            most = min(most, max_side * max_side * min(width, height) // max(width, height))
        if max_pixels:
            most = min(most, max_pixels)
        whole_w, whole_h = smart_resize(size_wh, factor=factor, min_pixels=least, max_pixels=most)
        longest = max_side // factor * factor if max_side else max(whole_w, whole_h)
        return min(whole_w, longest), min(whole_h, longest)

    def system(self, sent_wh: tuple[int, int]) -> CoordinateSystem:
        """The system of its answers about an image that was sent in the size `sent_wh`."""
        return THOUSAND if self.coordinates == "thousand" else resized(*sent_wh)

    def read(self, text: str) -> Found:
        """The boxes and points of an answer, in its own coordinates.

        Raises:
            UnreadableAnswer: not in the dialect's form.
        """
        if self.answer == "boxes":
            return read_boxes(text)
        return read_objects(text, box_keys=self.box_keys, point_keys=self.point_keys)


def dialects() -> dict[str, Dialect]:
    """All dialects by name."""
    table = read_package_toml("a4agent.experts", "dialects.toml")
    return {name: Dialect(name=name, **row) for name, row in table.items()}


def smart_resize(size_wh: tuple[int, int], *, factor: int, min_pixels: int, max_pixels: int) -> tuple[int, int]:
    """The size, in multiples of `factor` and within the area, that the processor of Qwen2.5-VL gives an image.

    Source: `smart_resize` of the Qwen2-VL image processor. It leaves a size that came from here as it is.
    """
    width, height = size_wh
    whole_w, whole_h = (round(side / factor) * factor for side in (width, height))
    if whole_w * whole_h > max_pixels:
        shrink = math.sqrt(width * height / max_pixels)
        whole_w, whole_h = (max(factor, math.floor(side / shrink / factor) * factor) for side in (width, height))
    elif whole_w * whole_h < min_pixels:
        grow = math.sqrt(min_pixels / (width * height))
        whole_w, whole_h = (math.ceil(side * grow / factor) * factor for side in (width, height))
    return whole_w, whole_h


def inner_experts(model: str, settings: Mapping[str, Any]) -> dict[Role, tuple[str, dict[str, Any]]]:
    """The VLM that a detector with these settings builds, as spec and settings; {} if it gets one that is built.

    Raises:
        UnknownNameError: no such dialect.
    """
    vlm = settings.get("vlm", "")
    if not isinstance(vlm, (str, Mapping)):
        return {}
    dialect = _dialect(model)
    own: dict[str, Any] = {"expert": vlm} if isinstance(vlm, str) else dict(cast("Mapping[str, Any]", vlm))
    spec = str(own.pop("expert", "") or dialect.vlm)
    return {"vlm": (spec, own)} if spec else {}


def _dialect(name: str) -> Dialect:
    known = dialects()
    if name not in known:
        raise UnknownNameError.of("dialect of 'vlm-grounding:'", name, known)
    return known[name]


class VlmDetector(ExpertBase):
    """A detector that asks a VLM in a dialect. Boxes and points come in the order of the answer, without scores.

    Args:
        model: the dialect's name.
        role: "detector".
        vlm: the VLM, as "provider:model" or a table {expert = "provider:model", SETTING = VALUE}; "" is the one
            the dialect was written for.
        max_tokens: the longest answer; 0 is the dialect's own limit.

    Raises:
        UnknownNameError: no such dialect.
        ConfigError: the dialect has no VLM of its own and none is given.
    """

    def __init__(
        self,
        model: str,
        role: Role,
        *,
        vlm: str | Mapping[str, Any] | VisionLanguageModel = "",
        max_tokens: int = 0,
    ) -> None:
        dialect = _dialect(model)
        if max_tokens < 0:
            raise ConfigError(f"max_tokens must be 0 (the dialect's own limit) or more, not {max_tokens!r}")
        max_tokens = max_tokens or dialect.max_tokens
        if isinstance(vlm, (str, Mapping)):
            inner = inner_experts(model, {"vlm": vlm})
            if not inner:
                raise ConfigError(f"'vlm-grounding:{model}' works with any VLM; name one: vlm = \"openai:gpt-4o\"")
            vlm = cast(VisionLanguageModel, registry.create(inner["vlm"][0], "vlm", inner["vlm"][1]))
        rules = {name: rule for name, rule in vars(dialect).items() if name != "source"}  # which is for people
        settings = {**rules, "max_tokens": max_tokens, "vlm": dict(vlm.fingerprint())}
        super().__init__(
            f"vlm-grounding:{dialect.name}",
            settings=settings,
            max_batch=vlm.max_batch,
            concurrency=vlm.concurrency,
        )
        self.dialect = dialect
        self.vlm = vlm
        if isinstance(vlm, Charges):
            self.price_known = vlm.price_known
        self._max_tokens = max_tokens
        shrinks = vlm.fingerprint().get("settings", {})
        self._limits = {name: int(shrinks.get(name) or 0) for name in ("max_side", "max_pixels")}
        dialect.sent_size((1000, 1000), **self._limits)

    def detect(self, requests: Sequence[DetectRequest]) -> list[Detection | A4Error]:
        """One chat request an image, all in one call of the VLM."""
        images = [self._sent(request.image) for request in requests]
        schema = _SCHEMA if self.dialect.schema else None
        chats = [
            ChatRequest((image,), self.dialect.prompt(request.phrase), schema=schema, max_tokens=self._max_tokens)
            for request, image in zip(requests, images, strict=True)
        ]
        answers = self.vlm.chat(chats)
        return [
            answer if isinstance(answer, A4Error) else self._read(answer, image.size, request.image.size)
            for answer, image, request in zip(answers, images, requests, strict=True)
        ]

    def close(self) -> None:
        self.vlm.close()

    def _sent(self, image: Image) -> Image:
        size = self.dialect.sent_size(image.size, **self._limits)
        if size == image.size:
            return image
        square = self.dialect.resize.startswith("square")
        return image.resize(size, Resampling.BILINEAR if square else Resampling.BICUBIC)

    def _read(
        self, answer: ChatAnswer, sent_wh: tuple[int, int], size_wh: tuple[int, int]
    ) -> Detection | UnreadableAnswer | TruncatedAnswer:
        try:
            found = self.dialect.read(answer.text)
        except UnreadableAnswer as error:
            failure: UnreadableAnswer | TruncatedAnswer = error
            if answer.finish_reason == "length":
                failure = TruncatedAnswer(
                    f"the answer was cut off after {self._max_tokens} tokens; raise the detector's setting max_tokens"
                )
            failure.usage = answer.usage
            return failure
        system = self.dialect.system(sent_wh)
        boxes, points = np.reshape(found.boxes, (-1, 4)), np.reshape(found.points, (-1, 2))
        if self.dialect.order == "yx":
            boxes, points = boxes[:, [1, 0, 3, 2]], points[:, ::-1]
        boxes, points = to_pixels(boxes, system, size_wh), to_pixels(points, system, size_wh)
        if self.dialect.whole_pixels:
            boxes, points = np.floor(boxes + 0.5), np.floor(points + 0.5)
        return Detection(
            boxes_xyxy=boxes.astype(np.float32),
            points_xy=points.astype(np.float32),
            text=answer.text,
            usage=answer.usage,
        )


create = VlmDetector
