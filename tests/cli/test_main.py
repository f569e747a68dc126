"""The front door: help, versions, exit codes."""

from __future__ import annotations

import importlib
import subprocess
import sys

import pytest
import typer

from a4agent import __version__
from a4agent.cli.main import COMMANDS, main


def test_every_command_is_there_and_its_help_line_is_its_own() -> None:
    for command, (module, line) in COMMANDS.items():
        loaded = importlib.import_module(f"a4agent.cli.{module}")
        found = getattr(loaded, "app", None)
        if isinstance(found, typer.Typer):
            continue
        assert (getattr(loaded, command).__doc__ or "").strip().splitlines()[0] == line, command


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main([command, "--help"])
    assert caught.value.code == 0
    assert "Usage" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [["nonsense"], ["predict", "--nonsense"], ["predict"]])
def test_wrong_words_exit_with_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


def test_the_version() -> None:
    said = subprocess.check_output([sys.executable, "-m", "a4agent.cli.main", "--version"], text=True)
    assert said.strip() == f"a4agent {__version__}"


def test_without_arguments_it_helps(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([])
    assert "predict" in capsys.readouterr().out


def test_an_interrupt_is_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted() -> list[str]:
        raise KeyboardInterrupt

    monkeypatch.setattr("a4agent.cli.data.names", interrupted)
    with pytest.raises(SystemExit) as ended:
        main(["data", "list"])
    assert ended.value.code == 130
    assert capsys.readouterr().err == "interrupted\n"
