"""Where this system wants files that can be made again, and how a file is replaced whole."""

from __future__ import annotations

import os
import re
import sys
import uuid
from contextlib import suppress
from pathlib import Path

DRAFT = re.compile(r"\.[0-9a-f]{32}\.tmp")


def system_cache() -> Path:
    """This package's folder in the system's place for caches; it need not exist."""
    home = Path.home()
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = home / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")
    return base / "a4agent"


def replace_file(path: Path, data: bytes, *, durable: bool = False) -> None:
    """Put `data` at `path` in one step: whoever looks, also after a kill, sees the old content or the new one.

    The folder is made. With `durable` the data is on the disk when this returns.

    Raises:
        OSError: it cannot be written; the old file is as it was, and nothing is left beside it.
    """
    draft = path.with_name(f".{uuid.uuid4().hex}.tmp")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with draft.open("wb") as file:
            file.write(data)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        os.replace(draft, path)
    except BaseException:
        with suppress(OSError):
            draft.unlink()
        raise


def is_draft(path: Path) -> bool:
    """Whether this is a file that `replace_file` was writing, or that a process killed meanwhile left behind."""
    return DRAFT.fullmatch(path.name) is not None
