"""Every system's own place for caches."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from a4agent.folders import system_cache


@pytest.mark.parametrize(
    ("platform", "variable", "expected"),
    [
        ("linux", "", "home/.cache/a4agent"),
        ("linux", "XDG_CACHE_HOME", "chosen/a4agent"),
        ("darwin", "XDG_CACHE_HOME", "home/Library/Caches/a4agent"),
        ("win32", "", "home/AppData/Local/a4agent"),
        ("win32", "LOCALAPPDATA", "chosen/a4agent"),
    ],
)
def test_the_place_is_the_systems(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, platform: str, variable: str, expected: str
) -> None:
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    if variable:
        monkeypatch.setenv(variable, str(tmp_path / "chosen"))
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    assert system_cache() == tmp_path / expected
