"""Every system's own place for caches, and files that are replaced whole."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from a4agent.files import is_draft, replace_file, system_cache


def test_the_place_is_the_systems(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert system_cache().is_relative_to(Path.home())
    if sys.platform == "linux":
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        assert system_cache() == tmp_path / "a4agent"


def test_a_file_is_replaced_and_its_folder_made(tmp_path: Path) -> None:
    path = tmp_path / "new" / "folder" / "file"
    for data in (b"one", b"two"):
        replace_file(path, data, durable=True)
        assert path.read_bytes() == data
    assert list(path.parent.iterdir()) == [path]


def test_a_replacement_that_fails_leaves_the_old_file_and_nothing_else(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    replace_file(tmp_path / "file", b"old")
    monkeypatch.setattr(os, "replace", _refuse)
    with pytest.raises(OSError, match="no"):
        replace_file(tmp_path / "file", b"new")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"file": b"old"}


def test_what_a_kill_leaves_is_known_by_its_name(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen: list[Path] = []
    monkeypatch.setattr(os, "replace", lambda draft, path: seen.append(draft))
    replace_file(tmp_path / "file", b"new")
    assert is_draft(seen[0])
    assert not any(is_draft(tmp_path / name) for name in ("file", ".file.tmp", "notes.tmp", ".hidden"))


def _refuse(*_: object) -> None:
    raise OSError("no")
