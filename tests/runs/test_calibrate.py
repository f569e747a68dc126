"""Calibrations from scored runs: they recover what is known, hold images out, and refuse what cannot be fitted."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("sklearn")

from a4agent.errors import DataError
from a4agent.runs.calibrate import _folds, _gathered, fit
from a4agent.runs.manifest import Manifest
from a4agent.runs.store import Record, Run
from a4agent.stages.calibration import read_calibration


def run_of(count: int, *, per_image: int = 2, oracle: str | None = None, constant: bool | None = None) -> Run:
    """Answers that are right with probability `mirror`; `noise` knows nothing, every third `mirror` is missing."""
    random = np.random.default_rng(3)
    records: dict[str, Record] = {}
    for i in range(count):
        chance = float(random.random())
        right = bool(random.random() < chance) if constant is None else constant
        checks = [
            {"name": "mirror", "value": chance if i % 3 else None, "note": ""},
            {"name": "noise", "value": float(random.random()), "note": ""},
        ]
        row: dict[str, Any] = {"id": f"{i}", "checks": checks, "status": "ok", "confidence": 0.5}
        row |= {"intersection": 80 if right else 20, "union": 100, "pictures": {"original": f"{i // per_image}.jpg"}}
        records[f"{i}"] = Record(row)
    return Run(Path("run"), Manifest({"benchmark": "drawn", "oracle": oracle}, {"label": "mine"}), records)


@pytest.mark.parametrize("kind", ["logistic", "isotonic"])
def test_a_signal_that_tells_is_told_from_one_that_does_not(kind: Any) -> None:
    found = fit([run_of(900)], kind)
    weights = dict(zip(found.features, found.coefficients, strict=True))
    assert weights["mirror"] > 10 * abs(weights["noise"])
    assert found.card["auroc"] > 0.65
    assert found.card["ece"] < 0.1
    assert (found.card["n"], found.card["images"], found.card["folds"], found.card["data"]) == (900, 450, 5, ["drawn"])
    for chance in (0.2, 0.5, 0.8):
        assert found.probability({"mirror": chance, "noise": 0.5}) == pytest.approx(chance, abs=0.12)
    assert found.probability({"noise": 0.5}) == pytest.approx(0.5, abs=0.12), "what is missing counts as the median"
    assert read_calibration(json.loads(json.dumps(found.to_dict()))) == found


def test_no_image_is_on_both_sides_of_a_fold() -> None:
    data = _gathered([run_of(60, per_image=6)])
    folds = _folds(data, 0)
    for image in np.unique(data.images):
        assert len(set(folds[data.images == image])) == 1


@pytest.mark.parametrize(
    ("run", "reason"),
    [
        (run_of(5), "at least 20 answers with checks"),
        (run_of(40, constant=True), "all 40 answers are right"),
        (run_of(40, constant=False), "all 40 answers are wrong"),
        (run_of(40, oracle="detector"), "have seen the truth"),
        (run_of(40, per_image=40), "on at least two images"),
    ],
)
def test_what_cannot_be_fitted_is_refused(run: Run, reason: str) -> None:
    with pytest.raises(DataError, match=reason):
        fit([run])
