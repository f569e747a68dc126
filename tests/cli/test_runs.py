"""`a4 report`, `compare`, `tables` and `calibrate` on run folders, as people and programs read them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from a4agent.cli.main import main
from a4agent.imaging.masks import encode_rle
from a4agent.runs.manifest import Manifest
from a4agent.runs.store import RunWriter
from a4agent.types import Affordance


def a4(*arguments: str | Path) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


def write_run(folder: Path, shared: Mapping[str, int], *, planned: int = 0, **identity: object) -> Path:
    """A run whose samples share so many of 100 pixels with their truth."""
    selection = {"limit": None, "shuffle": None, "samples": planned or len(shared)}
    plain = {"benchmark": "umd", "protocol": "strict", "oracle": None, "selection": selection}
    mask = encode_rle(np.ones((10, 10), bool))
    with RunWriter(folder, Manifest({**plain, **identity}, {"profile": folder.name})) as run:
        for id, pixels in shared.items():
            counts = {"intersection": pixels, "union": 100, "truth_pixels": 100, "prediction_pixels": pixels}
            run.add({**Affordance("touch", (10, 10), id=id).to_dict(), **counts, "truth": mask, "category": "mug"})
    return folder


def test_a_report_is_written_where_it_is_asked_for_and_opened(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    run = write_run(tmp_path / "run", {"a": 60})
    assert a4("report", run) == 0
    assert capsys.readouterr().out.strip() == str(run / "report.html")
    assert not opened
    assert a4("report", run, "--out", tmp_path / "page.html", "--open") == 0
    assert opened == [(tmp_path / "page.html").as_uri()]


def test_a_manifest_with_the_least_it_may_have_is_reported(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", {"a": 60})
    manifest = json.loads((run / "manifest.json").read_text())
    (run / "manifest.json").write_text(json.dumps({**manifest, "about": {}, "sessions": []}))
    assert a4("report", run) == 0


def test_a_damaged_session_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = write_run(tmp_path / "run", {"a": 60})
    manifest = json.loads((run / "manifest.json").read_text())
    manifest["sessions"][0]["git"] = {"commit": None}
    (run / "manifest.json").write_text(json.dumps(manifest))
    assert a4("report", run) == 2
    assert "sessions.0.git.commit" in capsys.readouterr().err.replace("\n", "")


def test_a_comparison_lists_a_dozen_of_the_samples_that_crossed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ids = [f"s{i:02d}" for i in range(20)]
    first = write_run(tmp_path / "first", {id: 20 if i < 13 else 90 for i, id in enumerate(ids)})
    second = write_run(tmp_path / "second", dict.fromkeys(ids[:19], 90), planned=20, settings={"pairing": "paper"})
    assert a4("compare", first, second) == 0
    out, err = capsys.readouterr()
    assert "19 shared samples, 1 only in the first, 0 only in the second; protocol strict" in out
    assert "settings: nothing -> {'pairing': 'paper'}" in out
    assert "crossed IoU 0.5 upwards: 13 (s00, " in out
    assert "s11 and 1 more)" in out
    assert "crossed IoU 0.5 downwards: 0\n" in out
    (giou,) = (line for line in out.splitlines() if line.startswith("gIoU"))
    assert giou.split()[1:4] == ["42.11", "90.00", "+47.89"]
    assert giou.endswith("clear")
    assert "a run is not complete; only its samples so far are compared" in err
    assert a4("compare", first, second, "--json") == 0
    (pair,) = json.loads(capsys.readouterr().out)["pairs"]
    assert (pair["shared"], pair["only_first"], len(pair["gained"])) == (19, 1, 13)


def test_runs_that_differ_in_their_oracle_show_what_stages_cost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = write_run(tmp_path / "plain", {"a": 40, "b": 40})
    detector = write_run(tmp_path / "detector", {"a": 70, "b": 70}, oracle="detector")
    assert a4("compare", plain, detector) == 0
    lines = capsys.readouterr().out.splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("what each stage costs"))
    assert lines[start + 2].split() == ["the", "run", "as", "it", "is", "40.00"]
    assert lines[start + 3].split() == ["detector", "70.00", "+30.00", "+30.00", "to", "+30.00"]


def test_a_page_compares_two_runs_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = [write_run(tmp_path / name, {"a": pixels}) for name, pixels in (("x", 20), ("y", 60), ("z", 70))]
    assert a4("compare", *runs, "--html", tmp_path / "page.html") == 2
    assert "two runs side by side, not 3" in capsys.readouterr().err.replace("\n", " ")
    assert a4("compare", *runs[:2], "--html", tmp_path / "page.html") == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "page.html")


def test_an_unknown_table_suggests_the_nearest(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = write_run(tmp_path / "run", {"a": 60})
    assert a4("tables", run, "--table", "umdd") == 2
    assert "did you mean 'umd'" in capsys.readouterr().err
    assert a4("tables", run, "--table", "umd") == 0
    assert "| **run** (ours)" in capsys.readouterr().out


def test_runs_without_checks_cannot_be_calibrated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = write_run(tmp_path / "run", {"a": 60})
    assert a4("calibrate", run, "--out", tmp_path / "mine.json") == 2
    assert "at least 20 answers with checks" in capsys.readouterr().err.replace("\n", " ")
    assert not (tmp_path / "mine.json").exists()
