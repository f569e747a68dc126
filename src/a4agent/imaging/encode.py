"""Encode pictures: for HTTP, the same picture always gives the same bytes.

Servers reuse the part of a prompt that has not changed, images included, only if its bytes are equal; so
each photo is encoded once and its bytes are kept while it is in memory.
"""

from __future__ import annotations

import base64
import io
import threading
import weakref
from dataclasses import dataclass, field
from typing import Any

from PIL.Image import Image

from a4agent.errors import ConfigError

FORMATS = {"jpeg": "JPEG", "png": "PNG"}


@dataclass(frozen=True)
class PictureEncoder:
    """Shrink to `max_side` pixels (0: never) and encode as "jpeg" (with `quality`) or "png"."""

    image_format: str = "jpeg"
    max_side: int = 2048
    quality: int = 95
    _kept: dict[int, tuple[weakref.ref[Image], bytes]] = field(default_factory=dict, repr=False, compare=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.image_format not in FORMATS:
            raise ConfigError(f"image_format = {self.image_format!r}: write one of {', '.join(sorted(FORMATS))}")
        if self.max_side < 0 or not 1 <= self.quality <= 100:
            raise ConfigError(f"max_side is 0 or more and quality 1 to 100, not {self.max_side!r} and {self.quality!r}")

    @property
    def settings(self) -> dict[str, Any]:
        """The settings that change the bytes."""
        lossy = {"quality": self.quality} if self.image_format == "jpeg" else {}
        return {"image_format": self.image_format, "max_side": self.max_side, **lossy}

    @property
    def media_type(self) -> str:
        return f"image/{self.image_format}"

    def encode(self, image: Image) -> bytes:
        """The picture's bytes. Equal pictures give equal bytes; a picture that is still alive is not encoded again."""
        key = id(image)
        with self._lock:
            kept = self._kept.get(key)
        if kept is not None and kept[0]() is image:
            return kept[1]
        data = self._encode(image)
        with self._lock:
            self._kept[key] = (weakref.ref(image, lambda _: self._kept.pop(key, None)), data)
        return data

    def data_url(self, image: Image) -> str:
        """The picture as "data:image/jpeg;base64,..."."""
        return f"data:{self.media_type};base64,{base64.b64encode(self.encode(image)).decode()}"

    def _encode(self, image: Image) -> bytes:
        picture = image.convert("RGB")
        if self.max_side and max(picture.size) > self.max_side:
            picture.thumbnail((self.max_side, self.max_side))
        options = {"quality": self.quality} if self.image_format == "jpeg" else {"compress_level": 3}
        return encoded(picture, FORMATS[self.image_format], **options)


def encoded(image: Image, file_format: str, **options: Any) -> bytes:
    """The bytes of a picture's file in one of Pillow's formats, with Pillow's options for it."""
    buffer = io.BytesIO()
    image.save(buffer, file_format, **options)
    return buffer.getvalue()
