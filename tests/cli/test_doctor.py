"""`a4 doctor`: what works, and the command that gets the rest."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from a4agent import requirements
from a4agent.cli.doctor import examine
from a4agent.cli.main import main
from servers import FaultyServer, as_json


def report(capsys: pytest.CaptureFixture[str]) -> dict[str, object]:
    with pytest.raises(SystemExit):
        main(["doctor", "--json"])
    return json.loads(capsys.readouterr().out)


def test_it_names_what_is_here(capsys: pytest.CaptureFixture[str]) -> None:
    found = report(capsys)
    assert found["profiles"]["offline"] == []  # type: ignore[index]
    assert found["cores"]


def test_it_works_without_a_home(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "nobody")
    assert report(capsys)["free_disk_gb"] is None


def test_it_says_what_is_wrong_with_the_settings(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert report(capsys)["settings"] == ""
    monkeypatch.setenv("A4_PROFIL", "offline")
    assert "A4_PROFILE" in str(report(capsys)["settings"])


def test_it_names_the_command_for_what_is_not(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        requirements, "EXTRAS", {**requirements.EXTRAS, "offline": requirements.Extra(("no_such_module_at_all",), "")}
    )
    with pytest.raises(SystemExit):
        main(["doctor"])
    said = capsys.readouterr().out
    assert "pip install 'a4agent[offline]'" in said
    assert "OPENAI_API_KEY" in said


def test_columns_line_up_and_what_runs_here_comes_first(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    absent = requirements.Extra(("no_such_module_at_all",), "1 GB")
    monkeypatch.setattr(
        requirements, "EXTRAS", dict.fromkeys(requirements.EXTRAS, absent) | {"offline": requirements.EXTRAS["offline"]}
    )
    monkeypatch.setattr("a4agent.cli.doctor.EXTRAS", requirements.EXTRAS)
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    with pytest.raises(SystemExit):
        main(["doctor"])
    blocks = {lines[0]: lines[1:] for lines in map(str.splitlines, capsys.readouterr().out.split("\n\n"))}
    commands = [line for title in ("Extras", "Keys") for line in blocks[title] if line.startswith("  –")]
    assert len({line.index(" pip " if " pip " in line else " export ") for line in commands}) == 1
    assert len({line.index("1 GB") for line in blocks["Extras"] if "1 GB" in line}) == 1
    assert blocks["Profiles"][0] == "  ✓ offline"
    assert len({line.index("a4 profiles ") for line in blocks["Profiles"][1:]}) == 1


def test_profiles_whose_model_is_about_to_go_say_so_without_a_key(capsys: pytest.CaptureFixture[str]) -> None:
    until = report(capsys)["profiles_until"]
    assert until == {name: {"openai:gpt-4o": "2027-01-14"} for name in ("authors", "paper", "without-dreamer")}
    with pytest.raises(SystemExit):
        main(["doctor"])
    (line,) = (line for line in capsys.readouterr().out.splitlines() if " paper " in line)
    assert line.endswith("openai:gpt-4o ends 2027-01-14")


def test_a_configured_model_about_to_go_is_named_without_a_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    Path("a4.toml").write_text("profile = 'paper'")
    assert examine()["retiring"] == {"openai:gpt-4o": "2027-01-14"}
    Path("a4.toml").write_text(
        "profile = 'paper'\n[thinker]\nvlm.base_url = 'http://127.0.0.1:9/v1'\n[dreamer]\nvlm.base_url = 'http://127.0.0.1:9/v1'"
    )
    assert examine()["retiring"] == {}


@pytest.mark.parametrize("announced", [{}, {"shutdown_date": "2027-03-01"}])
def test_a_model_about_to_be_switched_off_is_named(
    openai_server: FaultyServer, announced: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OPENAI_API_KEY", "x")
    model = as_json({"id": "gpt-4o", "object": "model", "created": 1, "owned_by": "a", **announced})
    openai_server.replies(model, models=model)
    vlm = f'{{ expert = "openai:gpt-4o", base_url = "{openai_server.url}", server = "openai" }}'
    Path("a4.toml").write_text(f"profile = 'offline'\n[thinker]\nvlm = {vlm}")
    assert examine()["retiring"] == {"openai:gpt-4o": announced.get("shutdown_date", "2027-01-14")}
    Path("a4.toml").write_text("profile = 'offline'")
    assert examine()["retiring"] == {}
