"""One writer a folder: a lock that the operating system lets go of when its holder dies, however it dies."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from a4agent.errors import DataError


@contextmanager
def hold(path: Path) -> Generator[None, None, None]:
    """Hold the lock file `path`; it says who holds it.

    Raises:
        DataError: another process (or another writer in this one) holds it.
        OSError: it cannot be opened, or the file system has no locks.
    """
    file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            _lock(file)
        except (BlockingIOError, PermissionError) as error:  # POSIX, Windows
            holder = path.read_text(encoding="utf-8", errors="replace").strip() or "another process"
            raise DataError(f"{str(path.parent)!r} is being written by {holder}; wait for it, or stop it") from error
        os.ftruncate(file, 0)
        os.lseek(file, 0, os.SEEK_SET)
        os.write(file, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
        yield
    finally:
        os.close(file)


def _lock(file: int) -> None:
    """Lock or raise OSError at once."""
    if sys.platform == "win32":
        import msvcrt

        os.lseek(file, 1 << 30, os.SEEK_SET)  # beyond the text, so that others can still read who holds it
        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
