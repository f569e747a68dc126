"""Answers kept on disk, by the content of the question: nothing is asked twice.

    CACHE/v1/3f/3f9c...e1.entry        one answer, one file
    {"sha256": "...", "answer": {"kind": "ChatAnswer", "text": "### Thinking ...", ...}}\\n
    <the bytes of a PNG, if the answer is a picture>

A file is written beside its place and renamed, so readers see all of it or nothing, however many processes
write and whenever they are killed; what is damaged all the same is a miss. A hit renews the file's time, and
when the folder outgrows its limit the files not used for longest go. Files of others are never touched.
"""

from __future__ import annotations

import logging
import os
import re
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from a4agent.engine import entries
from a4agent.errors import ConfigError
from a4agent.files import is_draft, replace_file, system_cache
from a4agent.protocols import Answer, ChatAnswer

log = logging.getLogger("a4agent")

FORMAT = "v1"
"""Changes when older entries can be read no more."""
ENTRY = re.compile(r"[0-9a-f]{64}\.entry")
KEEP = 0.9
"""The share of the limit that an eviction leaves. A process that added the rest counts anew: others write too."""
ABANDONED = 3600.0
"""Seconds after which a half-written file belongs to a process that is gone."""


def default_folder() -> Path:
    """A4_CACHE_DIR, or the place for caches of this system."""
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
        ConfigError: the folder cannot be made.
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
            raise ConfigError(f"the cache folder {str(folder)!r} cannot be made: {error}; set A4_CACHE_DIR") from error

    def get(self, key: str) -> Answer | None:
        """The answer kept under `key`, or None; a damaged one is removed."""
        path = self._path(key)
        try:
            data = path.read_bytes()
        except OSError:
            return None
        answer = entries.unpack(data)
        if answer is None:
            self.remove(key)
            return None
        with suppress(OSError):
            os.utime(path)
        return answer

    def put(self, key: str, answer: Answer) -> None:
        """Keep an answer, unless it is one that a second try may better (blank or cut off).

        A disk that is full or read-only costs a warning and not the run.
        """
        if isinstance(answer, ChatAnswer) and (answer.finish_reason == "length" or not answer.text.strip()):
            return
        data = entries.pack(answer)
        path = self._path(key)
        try:
            replace_file(path, data)
        except OSError as error:
            # Windows refuses to replace a file that another process reads: then the answer is there already.
            if not path.exists() and not self._warned:
                self._warned = True
                log.warning("answers cannot be kept in the cache at %s: %s", self.folder, error)
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
        """Count the answers, remove the longest unused if they are over the limit, and what killed writers left."""
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
        """(time of last use, bytes, path) of each answer; what killed writers left is removed on the way."""
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
    """Remove a file; whether it is gone, for instance because another process was faster."""
    try:
        path.unlink(missing_ok=True)
    except OSError:
        return False
    return True
