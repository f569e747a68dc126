"""The name of a question: the same expert, the same request and the same pixels give the same sha256."""

from __future__ import annotations

import hashlib
import json
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from a4agent.imaging.load import image_hash
from a4agent.protocols import Expert, Request

if TYPE_CHECKING:
    from PIL.Image import Image


class Keys:
    """Names questions: a sha256 over the expert's fingerprint, all fields of the request and the images' pixels."""

    def __init__(self) -> None:
        self._hashes: dict[int, tuple[weakref.ref[Image], str]] = {}

    def of(self, expert: Expert, request: Request) -> str:
        """The key of what `expert` answers to `request`. Callbacks and fields that are None are no part of it."""
        asked = {"expert": expert.fingerprint(), "verb": request.verb, "request": request}
        text = json.dumps(self._plain(asked), sort_keys=True, ensure_ascii=False, separators=(",", ":"))
        return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()

    def _plain(self, value: Any) -> Any:
        from PIL.Image import Image

        if value is None or isinstance(value, (str, int, float)):
            return value
        if isinstance(value, Image):
            return {"image": self._hash(value)}
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, np.ndarray):
            digest = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
            return {"array": digest, "dtype": str(value.dtype), "shape": list(value.shape)}
        if is_dataclass(value):
            held = {field.name: getattr(value, field.name) for field in fields(value)}
            return {name: self._plain(item) for name, item in held.items() if item is not None and not callable(item)}
        if isinstance(value, Mapping):
            return {str(name): self._plain(item) for name, item in cast("Mapping[Any, Any]", value).items()}
        if isinstance(value, Sequence) and not isinstance(value, bytes):
            return [self._plain(item) for item in cast("Sequence[Any]", value)]
        return str(value)

    def _hash(self, image: Image) -> str:
        """The hash of an image, computed once: the same object goes to three or four experts."""
        known = self._hashes.get(id(image))
        if known is not None and known[0]() is image:
            return known[1]
        name, number = image_hash(image), id(image)
        self._hashes[number] = (weakref.ref(image, lambda _: self._hashes.pop(number, None)), name)
        return name
