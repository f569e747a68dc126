"""Masks of another system become rows: right, of another size, missing and unreadable ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import layouts
from a4agent.benchmarks.predictions import Predictions
from a4agent.benchmarks.registry import load
from a4agent.errors import ConfigError, DataError
from a4agent.metrics import score
from a4agent.runs import scores
from a4agent.runs.compare import compare
from a4agent.runs.external import MISSING, score_predictions, write_run
from a4agent.runs.manifest import Manifest
from a4agent.runs.report import render
from a4agent.runs.store import Run
from a4agent.runs.tables import fill


def test_each_kind_of_prediction(tmp_path: Path) -> None:
    data = layouts.write_folder(tmp_path)
    theirs = tmp_path / "theirs"
    layouts.mask(theirs / "00000-mug.v1.png", (0, 2, 12, 10), (24, 16))  # twice the size: (0, 1, 6, 5)
    (theirs / "00001-mug.v1.png").write_bytes(b"no picture")

    outcomes = list(score_predictions(load("folder", data), Predictions(theirs)))

    assert [outcome.id for outcome in outcomes] == ["00000-mug.v1", "00001-mug.v1", "00002-mug.v2"]
    assert outcomes[0].row == (24, 24, "ok", 24, 24, True)
    assert outcomes[1].row == (0, 20, "error", 20, None, False)
    assert "is not an image" in outcomes[1].problem
    assert outcomes[2].row == (0, 16, "error", 16, None, False)
    assert outcomes[2].problem == MISSING
    scores = score([outcome.row for outcome in outcomes])
    assert (scores.n, scores.n_failed, scores.n_resized) == (3, 2, 1)
    assert scores.giou == pytest.approx(1 / 3)
    assert scores.ciou == 24 / 60


def test_a_truth_that_cannot_be_read_stops_the_score(tmp_path: Path) -> None:
    data = layouts.write_folder(tmp_path)
    layouts.mask(tmp_path / "theirs" / "00000-mug.v1.png", (0, 1, 6, 5))
    (data / "b" / "mug.v2_mask.png").unlink()

    with pytest.raises(DataError, match=r"mug\.v2_mask"):
        list(score_predictions(load("folder", data), Predictions(tmp_path / "theirs")))


def their_run(tmp_path: Path, name: str = "LISA-7B") -> Run:
    return write_run(load("folder", tmp_path / "mine"), Predictions(tmp_path / "theirs"), tmp_path / "run", name=name)


@pytest.fixture
def predicted(tmp_path: Path) -> Path:
    """Data, and predictions of which one is of another size, one unreadable and one missing."""
    layouts.write_folder(tmp_path)
    layouts.mask(tmp_path / "theirs" / "00000-mug.v1.png", (0, 2, 12, 10), (24, 16))
    (tmp_path / "theirs" / "00001-mug.v1.png").write_bytes(b"no picture")
    return tmp_path


def test_a_run_of_theirs_scores_as_their_masks_do(predicted: Path) -> None:
    run = their_run(predicted)
    outcomes = score_predictions(load("folder", predicted / "mine"), Predictions(predicted / "theirs"))
    assert scores.rows_of(run) == {outcome.id: outcome.row for outcome in outcomes}
    assert run.complete
    assert [record.row["error"] for record in run.records.values()][2] == "no prediction"
    page = render(run)
    assert "no prediction" in page
    assert "What it took" not in page, "nobody knows what their models were asked"


def test_their_row_stands_in_tables_and_comparisons(predicted: Path) -> None:
    run = their_run(predicted)
    assert "**LISA-7B** (scored here)" in fill([run])[0].render("markdown")
    ours = replace(run, manifest=Manifest({**run.manifest.identity, "settings": {"x": 1}}, {"label": "ours"}))
    del ours.manifest.identity["predictions"]
    pair = compare(ours, run)
    assert pair.result.n_shared == 3
    assert pair.changed == ("system: 'ours' there, 'LISA-7B' here",)


def test_a_system_fills_one_row_over_benchmarks(predicted: Path) -> None:
    run = their_run(predicted)
    elsewhere = {"benchmark": "ragnet-3doi", "predictions": "others"}
    hard = {"benchmark": "ragnet-handal-hard", "predictions": "more"}
    runs = [
        replace(run, manifest=replace(run.manifest, identity={**run.manifest.identity, **one}))
        for one in (elsewhere, hard)
    ]
    (line,) = [line for line in fill(runs)[0].lines if line.source == "scored here"]
    assert sum(cell.value is not None for cell in line.cells) == 4


def test_other_predictions_do_not_mix_into_a_run(predicted: Path) -> None:
    their_run(predicted)
    assert len((predicted / "run" / "samples.jsonl").read_text().splitlines()) == 3
    their_run(predicted)
    assert len((predicted / "run" / "samples.jsonl").read_text().splitlines()) == 3, "nothing is done twice"
    layouts.mask(predicted / "theirs" / "00002-mug.v2.png", (0, 1, 6, 5))
    with pytest.raises(ConfigError, match="predictions"):
        their_run(predicted)
