"""Answers kept on disk, by the content of the question: nothing is asked twice.

    CACHE/v2/3f/3f9c...e1.entry        one answer, one file: its checksum, a line of JSON, the PNG if it is a picture
    9c0d...                                      sha256 of the rest
    {"kind": "ChatAnswer", "text": "### Thinking ...", ...}

The key is a sha256 over the expert's fingerprint, all fields of the request and the pixels of its images. A file is
written beside its place and renamed, so readers see all of it or nothing, however many processes write and whenever
they are killed; a damaged file is a miss. A hit renews the file's time, and when the folder outgrows its limit the
files unused for longest go. Other files in the folder are never touched.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from PIL.Image import Image

from a4agent.errors import ConfigError, DataError, InputError
from a4agent.files import is_draft, replace_file, system_cache
from a4agent.imaging.encode import encoded
from a4agent.imaging.load import image_hash, load_image
from a4agent.imaging.masks import decode_rle, encode_rle
from a4agent.protocols import Answer, ChatAnswer, EditAnswer, Expert, Request, Segmentation
from a4agent.redaction import redact
from a4agent.types import Detection, Usage

log = logging.getLogger("a4agent")

FORMAT = "v2"
"""Changes when older entries can no longer be read."""
ENTRY = re.compile(r"[0-9a-f]{64}\.entry")
KEEP = 0.9
"""The share of the limit that an eviction leaves. A process that added the rest counts again: others write too."""
ABANDONED = 3600.0
"""Seconds after which the process that was writing a file counts as killed."""
KINDS: dict[str, type[Answer]] = {kind.__name__: kind for kind in (ChatAnswer, EditAnswer, Detection, Segmentation)}


def default_folder() -> Path:
    """A4_CACHE_DIR, or the system's cache folder."""
    chosen = os.environ.get("A4_CACHE_DIR")
    return Path(chosen).expanduser() if chosen else system_cache() / "answers"


@dataclass(frozen=True)
class CacheInfo:
    """How much a cache holds."""

    folder: Path
    entries: int
    bytes: int


class Cache:
    """A folder of answers, at most `limit_bytes` of them.

    Raises:
        ConfigError: the folder cannot be created.
    """

    def __init__(self, folder: Path, limit_bytes: float = 20e9) -> None:
        self.folder = folder
        self._root = folder / FORMAT
        self._limit = limit_bytes
        self._lock = threading.Lock()
        self._bytes: int | None = None
        self._added = 0
        self._warned = False
        try:
            self._root.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"cannot create the cache folder {str(folder)!r}: {error}; set A4_CACHE_DIR") from error

    def get(self, key: str) -> Answer | None:
        """The answer kept under `key`, or None; a damaged one is removed."""
        path = self._path(key)
        try:
            data = path.read_bytes()
        except OSError:
            return None
        answer = unpack(data)
        if answer is None:
            self.remove(key)
            return None
        with suppress(OSError):
            os.utime(path)
        return answer

    def put(self, key: str, answer: Answer) -> None:
        """Keep an answer, unless a second try may improve it (blank or cut off).

        A full or read-only disk is a warning.
        """
        if isinstance(answer, ChatAnswer) and (answer.finish_reason == "length" or not answer.text.strip()):
            return
        data = pack(answer)
        path = self._path(key)
        try:
            replace_file(path, data)
        except OSError as error:
            # Windows refuses to replace a file that another process reads; then the answer is already there.
            if not path.exists() and not self._warned:
                self._warned = True
                log.warning("cannot keep answers in the cache at %s: %s", self.folder, error)
            return
        self._grow(len(data))

    def remove(self, key: str) -> None:
        """Forget one answer."""
        with suppress(OSError):
            self._path(key).unlink()

    def info(self) -> CacheInfo:
        """Count the answers."""
        sizes = [size for _, size, _ in self._files()]
        return CacheInfo(self.folder, len(sizes), sum(sizes))

    def clear(self) -> CacheInfo:
        """Remove all answers; returns what was removed."""
        with self._lock:
            sizes = [size for _, size, path in self._files() if _removed(path)]
            self._bytes = None
        return CacheInfo(self.folder, len(sizes), sum(sizes))

    def _evict(self) -> None:
        """Count the answers, and remove those unused for longest while they are over the limit."""
        found = sorted(self._files())
        total = sum(size for _, size, _ in found)
        goal = total if total <= self._limit else self._limit * KEEP
        for _, size, path in found:
            if total <= goal:
                break
            if _removed(path):
                total -= size
        self._bytes, self._added = total, 0

    def _grow(self, size: int) -> None:
        with self._lock:
            self._added += size
            known = self._bytes
            if known is None or known + self._added > self._limit or self._added > (1 - KEEP) * self._limit:
                self._evict()

    def _path(self, key: str) -> Path:
        return self._root / key[:2] / f"{key}.entry"

    def _files(self) -> Iterator[tuple[float, int, Path]]:
        """(time of last use, bytes, path) of each answer; half-written files of killed processes are removed."""
        now = time.time()
        for folder in sorted(self._root.glob("[0-9a-f][0-9a-f]")):
            with suppress(OSError), os.scandir(folder) as found:
                for item in found:
                    with suppress(OSError):
                        state, path = item.stat(), Path(item.path)
                        if ENTRY.fullmatch(item.name):
                            yield state.st_mtime, state.st_size, path
                        elif is_draft(path) and now - state.st_mtime > ABANDONED:
                            path.unlink()


def _removed(path: Path) -> bool:
    """Remove a file; True if it is gone, even if another process removed it."""
    try:
        path.unlink(missing_ok=True)
    except OSError:
        return False
    return True


def key_of(expert: Expert, request: Request) -> str:
    """The key of what `expert` answers to `request`. Callbacks and fields that are None are not part of it."""
    asked = {"expert": expert.fingerprint(), "verb": request.verb, "request": request}
    text = json.dumps(_plain(asked), sort_keys=True, ensure_ascii=False, separators=(",", ":"))
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


def _plain(value: Any) -> Any:
    if value is None or isinstance(value, (str, int, float)):
        return value
    if isinstance(value, Image):
        return {"image": image_hash(value)}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        digest = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
        return {"array": digest, "dtype": str(value.dtype), "shape": list(value.shape)}
    if is_dataclass(value):
        held = {field.name: getattr(value, field.name) for field in fields(value)}
        return {name: _plain(item) for name, item in held.items() if item is not None and not callable(item)}
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in cast("Mapping[Any, Any]", value).items()}
    if isinstance(value, Sequence):
        return [_plain(item) for item in cast("Sequence[Any]", value)]
    return str(value)


def pack(answer: Answer) -> bytes:
    """An answer as bytes; `unpack` gives an equal one."""
    held = {field.name: _stored(getattr(answer, field.name)) for field in fields(answer)}
    line = json.dumps(redact({"kind": type(answer).__name__, **held})).encode()
    picture = answer.image.convert("RGB") if isinstance(answer, EditAnswer) else None
    body = line + b"\n" + (encoded(picture, "PNG", compress_level=1) if picture else b"")
    return hashlib.sha256(body).hexdigest().encode() + b"\n" + body


def unpack(data: bytes) -> Answer | None:
    """The answer in `data`, None if `pack` did not write it."""
    checksum, _, body = data.partition(b"\n")
    if hashlib.sha256(body).hexdigest().encode() != checksum:
        return None
    line, _, picture = body.partition(b"\n")
    try:
        held = json.loads(line)
        return KINDS[held.pop("kind")](**{name: _restored(value, picture) for name, value in held.items()})
    except (
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        OverflowError,
        RecursionError,
        OSError,
        InputError,
        DataError,
    ):
        return None


def _stored(value: Any) -> Any:
    """A field of an answer as JSON; of a picture only that there is one."""
    if isinstance(value, Usage):
        return {"usage": vars(value)}
    if isinstance(value, Image):
        return {"picture": True}
    if not isinstance(value, np.ndarray):
        return value
    shape = list(value.shape)
    if value.dtype == bool:
        return {"shape": shape, "masks": [encode_rle(mask) for mask in value.reshape(-1, *shape[-2:])]}
    return {"shape": shape, "dtype": str(value.dtype), "values": value.ravel().tolist()}


def _restored(value: Any, picture: bytes) -> Any:
    if not isinstance(value, dict):
        return value
    stored = cast("dict[str, Any]", value)
    if "usage" in stored:
        return Usage(**stored["usage"])
    if "picture" in stored:
        return load_image(picture)
    if "masks" in stored:
        masks = [decode_rle(mask) for mask in stored["masks"]]
        return np.array(masks, bool).reshape(stored["shape"])
    return np.array(stored["values"], dtype=np.dtype(stored["dtype"])).reshape(stored["shape"])
