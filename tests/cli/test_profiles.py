"""`a4 profiles`: what there is and what each needs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from a4agent.cli.main import main
from a4agent.config import profile_names


def said(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as caught:
        main(["profiles", *arguments])
    assert caught.value.code == 0
    return capsys.readouterr().out


def test_all_profiles_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    listed = said(capsys)
    for name in profile_names():
        assert name in listed


def test_what_runs_here_comes_first_and_memory_is_short(capsys: pytest.CaptureFixture[str]) -> None:
    listed = said(capsys).splitlines()
    assert listed[1].split()[:2] == ["●", "offline"]
    assert "quantisation" not in "".join(listed)
    assert "dreamer.editor.quantisation = 4bit" in said(capsys, "paper")


def test_one_profile_shows_its_experts_and_what_is_missing(capsys: pytest.CaptureFixture[str]) -> None:
    shown = said(capsys, "paper")
    assert "openai:gpt-4o" in shown
    assert "OPENAI_API_KEY" in shown


def test_profiles_are_shown_without_local_settings(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a4.toml").write_text("[spotter]\nsegmenter = 'sam2:tiny'\n[engin]\n")
    assert "sam2:tiny" not in said(capsys, "offline")


def test_json_is_one_value_with_everything(capsys: pytest.CaptureFixture[str]) -> None:
    rows = {row["name"]: row for row in json.loads(said(capsys, "--json"))}
    assert sorted(rows) == profile_names()
    assert rows["offline"]["missing"] == []
    assert all(row["summary"] and row["licences"] for row in rows.values())
    assert any("OPENAI_API_KEY" in missing["what"] + missing["fix"] for missing in rows["paper"]["missing"])


def test_an_unknown_profile_suggests_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["profiles", "papr"])
    assert caught.value.code == 2
    assert "did you mean 'paper'" in capsys.readouterr().err
