"""The folder of uploads: one a process, empty at its start, gone at its end, also after a kill.

    /tmp/a4-uploads-k3x9q2/           gradio keeps each photo in a folder below
    /tmp/a4-uploads-k3x9q2/.lock      held by the process that uses it

A process that is killed cannot remove its folder, and the photos in it belong to its visitors; the next process of the
same user does. A lock, unlike a process id, also works across containers.
"""

from __future__ import annotations

import atexit
import os
import shutil
import sys
import tempfile
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

PREFIX = "a4-uploads-"
LOCK = ".lock"


@lru_cache(maxsize=1)
def upload_folder() -> str:
    """A folder of this process alone; gradio's default is shared by all users of the machine."""
    remove_abandoned(Path(tempfile.gettempdir()))
    folder = tempfile.mkdtemp(prefix=PREFIX)
    if (held := _locked(Path(folder))) is not None:
        atexit.register(os.close, held)
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return os.path.realpath(folder)


def remove_abandoned(parent: Path) -> None:
    """Remove the upload folders below `parent` that are this user's and that no process holds."""
    for folder in parent.glob(f"{PREFIX}*"):
        with suppress(OSError):
            if folder.is_symlink() or (hasattr(os, "getuid") and folder.lstat().st_uid != os.getuid()):
                continue
            # A folder without its lock has just been made, and its process is about to take it.
            if not (folder / LOCK).is_file() or (held := _locked(folder)) is None:
                continue
            try:
                shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(held)


def _locked(folder: Path) -> int | None:
    """The open lock of a folder; None where another process holds it, or the system has no such locks."""
    if sys.platform == "win32":
        return None
    import fcntl

    file = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(file)
        return None
    return file
