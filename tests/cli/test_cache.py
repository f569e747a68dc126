"""`a4 cache`: what is kept is counted and cleared, and nothing but that."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from a4agent.cli.main import main
from a4agent.engine.cache import Cache
from a4agent.protocols import ChatAnswer


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Cache:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("A4_CACHE_DIR", str(tmp_path / "kept"))
    cache = Cache(tmp_path / "kept")
    for number in range(3):
        cache.put(f"{number:064x}", ChatAnswer("hello"))
    return cache


def a4(*arguments: str) -> int:
    with pytest.raises(SystemExit) as left:
        main(["cache", *arguments])
    return int(left.value.code or 0)


def test_info_counts(cache: Cache, capsys: pytest.CaptureFixture[str]) -> None:
    assert a4("info", "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["entries"] == 3
    assert said["bytes"] == cache.info().bytes
    assert Path(said["folder"]) == cache.folder
    assert a4("info") == 0
    assert "3 answers" in capsys.readouterr().out


def test_clear_asks_first(cache: Cache, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("typer.confirm", lambda *_, **__: False)
    assert a4("clear") == 2
    assert "--yes" in capsys.readouterr().err
    assert cache.info().entries == 3
    assert a4("clear", "--yes") == 0
    assert "removed 3 answers" in capsys.readouterr().out
    assert cache.info().entries == 0


def test_a_cache_that_is_not_there_is_empty_and_stays_so(
    cache: Cache, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    elsewhere = tmp_path / "elsewhere"
    assert a4("info", "--folder", str(elsewhere)) == 0
    assert "0 answers" in capsys.readouterr().out
    assert a4("clear", "--yes", "--folder", str(elsewhere)) == 0
    assert not elsewhere.exists()
    assert cache.info().entries == 3


def test_inspecting_another_folder_changes_nothing(
    cache: Cache, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    assert a4("info", "--folder", str(photos)) == 0
    assert "0 answers" in capsys.readouterr().out
    assert a4("clear", "--yes", "--folder", str(photos)) == 0
    assert "nothing to remove" in capsys.readouterr().out
    assert list(photos.iterdir()) == []


def test_the_settings_say_where_it_is(cache: Cache, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a4.toml").write_text('[engine]\ncache_dir = "named"\ncache_gb = 2.5\n')
    assert a4("info") == 0
    said = capsys.readouterr().out
    assert said.startswith("named: 0 answers")
    assert "2.5 GB" in said
