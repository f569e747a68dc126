"""The figures of a confidence agree with vectors worked out by hand, in any order of the samples."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pictures
from a4agent.metrics import Row
from a4agent.runs import scores, trust
from a4agent.runs.bench import Bench
from a4agent.runs.manifest import Manifest
from a4agent.runs.store import Record, Run
from a4agent.runs.trust import aurc, auroc, compare, ece, reliability, risk_coverage, with_accept

CONFIDENCE = np.array([0.9, 0.8, 0.7, 0.6, 0.2])
RIGHT = np.array([True, True, False, True, False])


def run_of(answers: Sequence[tuple[float | None, int, str]]) -> Run:
    """A run of answers (confidence, intersection of 100, status)."""
    rows = {
        f"{i}": Record({"id": f"{i}", "confidence": c, "intersection": n, "union": 100, "status": status})
        for i, (c, n, status) in enumerate(answers)
    }
    return Run(Path("run"), Manifest({"settings": {"verifier": {"accept": 0.5}}, "protocol": "strict"}), rows)


def test_auroc_counts_ordered_pairs() -> None:
    assert auroc(CONFIDENCE, RIGHT) == pytest.approx(5 / 6)  # of 3 x 2 pairs, 0.6 against 0.7 is the wrong way round
    assert auroc(np.array([0.5, 0.5, 0.5]), np.array([True, False, True])) == 0.5
    assert auroc(np.array([0.1, 0.9]), np.array([True, False])) == 0.0
    assert math.isnan(auroc(np.array([0.1, 0.9]), np.array([True, True])))


def test_risk_falls_on_the_most_confident_first() -> None:
    expected = [[0.2, 0], [0.4, 0], [0.6, 1 / 3], [0.8, 1 / 4], [1.0, 2 / 5]]
    assert risk_coverage(CONFIDENCE, ~RIGHT) == pytest.approx(np.array(expected))
    assert aurc(CONFIDENCE, ~RIGHT) == pytest.approx((1 / 3 + 1 / 4 + 2 / 5) / 5)


def test_ties_have_their_mean_risk_in_any_order() -> None:
    confidence, wrong = np.array([0.9, 0.4, 0.4, 0.4, 0.4]), np.array([False, True, False, False, True])
    for order in ([0, 1, 2, 3, 4], [4, 2, 1, 3, 0]):
        risks = risk_coverage(confidence[order], wrong[order])[:, 1]
        assert risks == pytest.approx([0, 0.5 / 2, 1 / 3, 1.5 / 4, 2 / 5])


def test_calibration_error_weighs_the_bins() -> None:
    confidence, right = np.array([0.95, 0.95, 0.15, 1.0]), np.array([True, False, False, True])
    # bin 0.9 to 1: mean confidence 2.9 / 3, 2 of 3 right; bin 0.1 to 0.2: 0.15, none right
    assert ece(confidence, right) == pytest.approx((0.9 + 0.15) / 4)
    last, low = reliability(confidence, right)[9], reliability(confidence, right)[1]
    assert (last.n, low.n) == (3, 1)
    assert (last.confidence, last.right) == pytest.approx((2.9 / 3, 2 / 3))
    assert math.isnan(reliability(confidence, right)[5].right)


def test_coverage_and_accepted_scores_count_every_sample() -> None:
    run = run_of([(0.9, 80, "ok"), (0.8, 40, "ok"), (0.3, 90, "abstained"), (None, 0, "error")])
    found = trust.trust(run, resamples=20)
    assert found
    assert (found.n, found.n_rated, found.n_abstained, found.accept) == (4, 3, 1, 0.5)
    assert found.values["coverage"] == 0.5
    assert found.values["accepted_giou"] == pytest.approx(0.6)
    assert found.values["accepted_right"] == 0.5
    assert found.values["brier"] == pytest.approx((0.1**2 + 0.8**2 + 0.7**2) / 3)
    assert json.dumps(found.to_dict(), allow_nan=False)


def test_an_abstained_answer_is_scored_as_it_is() -> None:
    assert not Row(80, 100, "abstained").failed
    run = run_of([(0.9, 80, "ok"), (0.3, 90, "abstained")])
    assert scores.score(run).giou == pytest.approx(0.85)


def test_another_threshold_moves_only_what_has_a_confidence() -> None:
    run = run_of([(0.9, 80, "ok"), (0.6, 40, "ok"), (0.3, 90, "abstained"), (None, 0, "empty")])
    at = [record.status for record in with_accept(run, 0.2).records.values()]
    assert at == ["ok", "ok", "ok", "empty"]
    assert [r.status for r in with_accept(run, 0.9).records.values()] == ["ok", "abstained", "abstained", "empty"]
    assert [r.status for r in run.records.values()] == ["ok", "ok", "abstained", "empty"], "the run is as it was"


def test_runs_are_paired() -> None:
    first = run_of([(0.9, 80, "ok"), (0.6, 20, "ok"), (0.3, 90, "abstained"), (0.2, 10, "abstained")])
    better = {id: Record({**r.row, "confidence": r.iou}) for id, r in first.records.items()}
    changes = compare(first, replace(first, records=better), resamples=50)
    assert changes
    (before, after), change = changes["auroc"]
    assert (before, after) == (0.75, 1.0)
    assert change.value == 0.25
    assert change.low <= 0.25 <= change.high
    nothing = {id: Record({**r.row, "confidence": None}) for id, r in first.records.items()}
    assert compare(first, replace(first, records=nothing)) is None


def test_a_run_without_confidences_has_no_trust(bench: Callable[..., Bench]) -> None:
    assert trust.trust(bench().run(pictures.agent())) is None
