"""`a4 data make sim`, end to end."""

from __future__ import annotations

from pathlib import Path

import pytest

from a4agent.cli.main import main
from a4agent.errors import MissingExtraError

THINGS = """
[package.robosuite]
version = "1.5.2"
licence = "MIT"
folder = "robosuite/models/assets"

[[thing]]
name = "door"
split = "test"
from = "robosuite"
file = "objects/door.xml"
root = "object"
front = 180
part.handle = { phrase = "the handle of the door", geoms = [{ body = "latch" }] }
task = [
    { say = "Open the door.", part = "handle", affordance = "pull" },
    { say = "Let the cat in.", part = "handle", affordance = "pull", direct = false },
]
"""


def test_a_set_of_ones_own_things_can_be_checked(
    simulator: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.toml").write_text(THINGS)
    with pytest.raises(SystemExit) as stopped:
        main(f"data make sim --out {tmp_path}/set --n 2 --things {tmp_path}/mine.toml --workers 1".split())
    assert stopped.value.code == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "set")
    with pytest.raises(SystemExit) as stopped:
        main(["data", "check", "sim", str(tmp_path / "set")])
    assert stopped.value.code == 0
    assert "all there" in capsys.readouterr().out


def test_missing_assets_exit_as_a_usage_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from a4agent.sim import make

    def missing(*_: object) -> dict[str, str]:
        raise MissingExtraError("not installed: pip install --no-deps metaworld==3.1.1")

    monkeypatch.setattr(make, "check_installed", missing)
    with pytest.raises(SystemExit) as stopped:
        main(["data", "make", "sim", "--out", str(tmp_path / "set")])
    assert stopped.value.code == 2
    assert "pip install --no-deps" in capsys.readouterr().err.replace("\n", " ")
