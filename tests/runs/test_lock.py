"""One writer a folder, and a lock that dies with its holder."""

from __future__ import annotations

import errno
import subprocess
import sys
from pathlib import Path

import pytest

from a4agent.errors import DataError
from a4agent.runs import lock
from a4agent.runs.lock import hold


def test_a_lock_is_held_by_one_and_free_again_afterwards(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    with hold(path), pytest.raises(DataError, match="is being written by process"), hold(path):
        pass
    with hold(path):
        pass


def test_a_file_system_without_locks_is_not_blamed_on_another_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(lock, "_lock", refuse)
    with pytest.raises(OSError, match="No locks available"), hold(tmp_path / "lock"):
        pass


def test_a_killed_holder_holds_nothing(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    code = "\n".join(
        [
            "import pathlib, sys",
            "from a4agent.runs.lock import hold",
            "with hold(pathlib.Path(sys.argv[1])): print(1, flush=True); sys.stdin.read()",
        ]
    )
    with subprocess.Popen([sys.executable, "-c", code, str(path)], stdin=-1, stdout=-1) as other:
        assert other.stdout is not None
        assert other.stdout.readline().strip() == b"1"
        with pytest.raises(DataError, match=f"process {other.pid}"), hold(path):
            pass
        other.kill()
    with hold(path):
        assert str(other.pid) not in path.read_text()
