"""Masks of another system become rows: right, of another size, missing and unreadable ones."""

from __future__ import annotations

from pathlib import Path

import pytest

import layouts
from a4agent.benchmarks.predictions import Predictions
from a4agent.benchmarks.registry import load
from a4agent.errors import DataError
from a4agent.metrics import score
from a4agent.runs.external import MISSING, score_predictions


def test_each_kind_of_prediction(tmp_path: Path) -> None:
    data = layouts.write_folder(tmp_path)
    theirs = tmp_path / "theirs"
    layouts.mask(theirs / "00000-mug.v1.png", (0, 2, 12, 10), (24, 16))  # twice the size: (0, 1, 6, 5)
    (theirs / "00001-mug.v1.png").write_bytes(b"no picture")

    outcomes = list(score_predictions(load("folder", data), Predictions(theirs)))

    assert [outcome.id for outcome in outcomes] == ["00000-mug.v1", "00001-mug.v1", "00002-mug.v2"]
    assert outcomes[0].row == (24, 24, "ok", 24, 24, True)
    assert outcomes[1].row == (0, 20, "error", 20, None, False)
    assert "cannot be read" in outcomes[1].problem
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
