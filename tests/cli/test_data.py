"""`a4 data`: what is wrong with a dataset, and what it asks, as people and programs read it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import layouts
from a4agent.benchmarks.registry import load
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


def a4(*arguments: str | Path) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


def test_a_whole_dataset(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert a4("data", "check", "folder", layouts.write_folder(tmp_path)) == 0

    printed = capsys.readouterr().out
    assert "3, 3 readable" in printed
    assert printed.rstrip().endswith("all there")


def test_what_is_missing_is_counted_named_and_ends_with_where_to_get_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = layouts.write_ragnet(tmp_path)
    next(data.rglob("rgb/other.frame.jpg")).unlink()

    assert a4("data", "check", "ragnet-handal-hard", data) == 1

    printed = capsys.readouterr().out
    assert "2 of 1003 published, 1 readable" in printed
    assert "1 images, 0 masks" in printed
    assert "00002-other.frame: image missing" in printed
    assert "CC-BY-NC-SA-4.0" in printed
    assert "its authors' code: --protocol ragnet" in printed
    assert "NVlabs/HANDAL" in printed.splitlines()[-1]


def test_json_holds_every_problem(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = layouts.write_umd(tmp_path)
    for file in data.rglob("*_rgb.jpg"):
        file.write_bytes(b"broken")

    assert a4("data", "check", "umd", data, "--option", "rule=affordance-r1", "--json") == 1

    found = json.loads(capsys.readouterr().out)
    assert len(found["problems"]) == 12
    assert {problem["kind"] for problem in found["problems"]} == {"image broken"}
    assert found["fingerprint"]["options"] == {"rule": "affordance-r1"}
    assert found["ok"] is False


def test_a_malicious_pickle_is_refused_without_a_traceback(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = layouts.write_ragnet(tmp_path)
    (data / "data" / "3doi_easy_reasoning_val.pkl").write_bytes(b"cos\nsystem\n(S'touch ran'\ntR.")

    assert a4("data", "check", "ragnet-3doi", data) == 2

    said = capsys.readouterr().err
    assert "os.system" in said
    assert "Traceback" not in said


def test_queries_hold_the_public_half_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = layouts.write_instructpart(tmp_path)

    assert a4("data", "queries", "instructpart", data, "--option", "instruction=2") == 0

    printed = capsys.readouterr().out
    rows = [json.loads(line) for line in printed.splitlines()]
    assert [set(row) for row in rows] == [{"id", "image", "instruction"}] * 4
    assert rows[0]["instruction"] == "000001 question 2"
    assert Path(rows[0]["image"]).is_file()
    assert layouts.SECRET not in printed


def test_a_question_that_no_terminal_can_show_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = layouts.write_folder(tmp_path)
    rows = [json.loads(line) for line in (data / "samples.jsonl").read_text().splitlines()]
    rows[0]["instruction"] = "open \ud800 it"
    (data / "samples.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))

    assert a4("data", "queries", "folder", data) == 0

    assert json.loads(capsys.readouterr().out.splitlines()[0])["instruction"] == "open \ud800 it"


def test_queries_write_pictures_that_lie_in_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = layouts.write_reasonaff(tmp_path)

    assert a4("data", "queries", "reasonaff", data) == 2
    assert "--images" in capsys.readouterr().err
    assert a4("data", "queries", "reasonaff", data, "--images", tmp_path / "out") == 0

    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [Path(row["image"]).stem for row in rows] == [sample.id for sample in load("reasonaff", data)]
    assert all(Path(row["image"]).is_file() for row in rows)


def test_list_names_every_benchmark_and_its_options(capsys: pytest.CaptureFixture[str]) -> None:
    assert a4("data", "list", "--json") == 0

    found = {row["benchmark"]: row for row in json.loads(capsys.readouterr().out)}
    assert set(found) >= {"reasonaff", "ragnet-3doi", "ragnet-handal-easy", "ragnet-handal-hard", "umd", "folder"}
    assert found["umd"]["options"] == {"rule": "a4"}
    assert all(row["about"] for row in found.values())


def test_an_option_of_another_form(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert a4("data", "check", "umd", tmp_path, "--option", "rule") == 2
    assert "NAME=VALUE" in capsys.readouterr().err


def test_a_set_of_custom_things_can_be_checked(
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
