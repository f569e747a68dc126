from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from a4agent.serve import uploads

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="locks of POSIX")
START = "from a4agent.serve.uploads import upload_folder; print(upload_folder(), flush=True); input()"


def start(parent: Path) -> tuple[subprocess.Popen[str], Path]:
    """A process with an upload folder, and the folder with a photo in it."""
    environment = {**os.environ, "TMPDIR": str(parent)}
    process = subprocess.Popen(
        [sys.executable, "-c", START], env=environment, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdout
    folder = Path(process.stdout.readline().strip())
    (folder / "abc").mkdir()
    (folder / "abc" / "photo.jpg").write_bytes(b"a face")
    return process, folder


def test_the_folder_of_a_killed_process_goes_and_that_of_a_live_one_stays(tmp_path: Path) -> None:
    killed, abandoned = start(tmp_path)
    with killed:
        killed.kill()
    assert abandoned.exists()
    running, used = start(tmp_path)
    with running:
        assert not abandoned.exists()
        uploads.remove_abandoned(tmp_path)
        assert (used / "abc" / "photo.jpg").exists()
        assert used.stat().st_mode & 0o777 == 0o700
        running.communicate("\n")
    assert not list(tmp_path.iterdir())


def test_what_is_not_an_abandoned_folder_of_ours_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / uploads.LOCK).touch()
    (tmp_path / f"{uploads.PREFIX}link").symlink_to(outside)
    (tmp_path / f"{uploads.PREFIX}file").touch()
    (tmp_path / f"{uploads.PREFIX}new").mkdir()  # its process has not locked it yet
    others = tmp_path / f"{uploads.PREFIX}others"
    others.mkdir()
    (others / uploads.LOCK).touch()
    before = sorted(tmp_path.rglob("*"))
    with monkeypatch.context() as another_user:
        another_user.setattr(os, "getuid", lambda: -1)
        uploads.remove_abandoned(tmp_path)
    assert sorted(tmp_path.rglob("*")) == before
    uploads.remove_abandoned(tmp_path)
    assert sorted(tmp_path.rglob("*")) == [path for path in before if others not in (path, path.parent)]
