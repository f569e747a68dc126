"""`a4 score`: another system's masks under the same protocols, with what is missing said and counted."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import layouts
from a4agent import metrics
from a4agent.benchmarks.registry import load
from a4agent.cli.main import main
from a4agent.imaging.masks import encode_rle


def a4(*arguments: str | Path) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return layouts.write_folder(tmp_path)


def test_perfect_masks_score_one(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    masks = {sample.id: encode_rle(sample.truth.mask()) for sample in load("folder", data)}
    (tmp_path / "theirs.json").write_text(json.dumps(masks))

    assert a4("score", "folder", "--predictions", tmp_path / "theirs.json", "--data", data, "--json") == 0

    found = json.loads(capsys.readouterr().out)
    assert [found["scores"][name] for name in ("giou", "ciou", "p50", "p50_95")] == [1, 1, 1, 1]
    assert found["scores"]["protocol"] == "strict"
    assert found["benchmark"] == load("folder", data).fingerprint()


def test_missing_ones_fail_and_strays_are_named(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    layouts.mask(tmp_path / "theirs" / "00000-mug.v1.png", (0, 1, 6, 5))
    layouts.mask(tmp_path / "theirs" / "00001-mgu.v1.png", (0, 1, 6, 5))

    arguments = ("score", "folder", "--predictions", tmp_path / "theirs", "--data", data, "--by-category")
    assert a4(*arguments) == 1

    printed = capsys.readouterr()
    assert "no prediction for 2 of 3 samples" in printed.err
    assert "00001-mgu.v1" in printed.err
    assert "n 3  scored 3  failed 2" in printed.out
    assert "gIoU     33.33" in printed.out
    assert f"{layouts.SECRET}  n 3" in printed.out


def test_a_protocol_may_drop_what_strict_counts(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    layouts.mask(tmp_path / "theirs" / "00000-mug.v1.png", (0, 1, 6, 5))

    arguments = ("score", "folder", "--predictions", tmp_path / "theirs", "--data", data)
    assert a4(*arguments, "--protocol", "affordance-r1", "--json") == 1

    scores = json.loads(capsys.readouterr().out)["scores"]
    assert (scores["giou"], scores["n"], scores["n_scored"], scores["n_failed"]) == (1, 3, 1, 2)


def test_ragnet_prints_a_dash_where_it_defines_nothing(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    layouts.mask(tmp_path / "theirs" / "00000-mug.v1.png", (0, 1, 6, 5))

    a4("score", "folder", "--predictions", tmp_path / "theirs", "--data", data, "--protocol", "ragnet")

    assert "P@50         -" in capsys.readouterr().out


def test_names_that_fit_no_sample_are_an_error_that_shows_right_ones(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    layouts.mask(tmp_path / "theirs" / "mug.png", (0, 1, 6, 5))

    assert a4("score", "folder", "--predictions", tmp_path / "theirs", "--data", data) == 2

    said = capsys.readouterr().err.replace("\n", "")
    assert "00000-mug.v1.png" in said
    assert "found mug" in said


def test_no_samples(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "samples.jsonl").write_text("")

    assert a4("score", "folder", "--predictions", tmp_path, "--data", tmp_path) == 2
    assert "no samples" in capsys.readouterr().err


def test_masks_are_kept_as_a_run_of_that_name(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    layouts.mask(tmp_path / "theirs" / "00000-mug.v1.png", (0, 1, 6, 5))
    run = tmp_path / "run"
    kept = ("--out", run, "--label", "LISA-7B")
    assert a4("score", "folder", "--predictions", tmp_path / "theirs", "--data", data, *kept) == 1
    assert f"kept as a run in {run}" in capsys.readouterr().err
    assert a4("tables", run, "--format", "csv") == 0
    assert "folder,LISA-7B,scored here,undeclared,33.33" in capsys.readouterr().out


def test_kept_masks_are_scored_once(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    layouts.mask(tmp_path / "theirs" / "00000-mug.v1.png", (0, 1, 6, 5))
    scored: list[object] = []
    measured = metrics.measure_best
    monkeypatch.setattr(metrics, "measure_best", lambda *given: scored.append(given) or measured(*given))

    a4("score", "folder", "--predictions", tmp_path / "theirs", "--data", data, "--out", tmp_path / "run")

    assert len(scored) == 3


def test_masks_of_another_size_are_named_and_far_ones_refused(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (sample, *_) = load("folder", data)
    height, width = sample.truth.mask().shape
    arguments = ("score", "folder", "--predictions", tmp_path / "theirs.json", "--data", data)

    def write(factor: int) -> None:
        small = np.ones((height * factor, width * factor), bool)
        (tmp_path / "theirs.json").write_text(json.dumps({sample.id: encode_rle(small)}))

    write(2)
    assert a4(*arguments) == 1
    assert f"1 masks were resized to the truth's size: {sample.id}" in capsys.readouterr().err.replace("\n", "")
    write(5)
    assert a4(*arguments) == 2
    said = capsys.readouterr().err.replace("\n", "")
    assert f"the prediction for '{sample.id}' is {5 * width} x {5 * height}" in said
    assert "pass --resize" in said
    assert a4(*arguments, "--resize") == 1
    assert a4(*arguments, "--resize", "--leak", "memory=no") == 2
    assert "--leak takes trained, truth or shared" in capsys.readouterr().err
