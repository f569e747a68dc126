"""`a4 doctor`: what works, and the command that gets the rest."""

from __future__ import annotations

import json

import pytest

from a4agent import availability
from a4agent.cli.main import main


def report(capsys: pytest.CaptureFixture[str]) -> dict[str, object]:
    with pytest.raises(SystemExit):
        main(["doctor", "--json"])
    return json.loads(capsys.readouterr().out)


def test_it_names_what_is_here(capsys: pytest.CaptureFixture[str]) -> None:
    found = report(capsys)
    assert found["profiles"]["offline"] == []  # type: ignore[index]
    assert found["cores"]


def test_it_names_the_command_for_what_is_not(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(availability, "EXTRAS", {**availability.EXTRAS, "offline": ("no_such_module_at_all",)})
    with pytest.raises(SystemExit):
        main(["doctor"])
    said = capsys.readouterr().out
    assert "pip install 'a4agent[offline]'" in said
    assert "OPENAI_API_KEY" in said
