"""What a run scored, by groups, and in words why a sample missed."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from a4agent.runs import scores
from a4agent.runs.store import Record, Run


def test_scores_json_is_what_the_run_scored(run: Run) -> None:
    scores.save(run)
    kept = json.loads((run.folder / "scores.json").read_text())
    assert kept["scores"]["giou"] == scores.score(run).giou
    assert set(kept["groups"]["category"]) == {"kind 0", "kind 1", "kind 2"}


def test_outcomes_say_why_a_sample_missed() -> None:
    def outcome(intersection: int, found: int, truth: int, status: str = "ok") -> str:
        row = {"intersection": intersection, "union": found + truth - intersection, "status": status}
        return scores.outcome(Record({**row, "prediction_pixels": found, "truth_pixels": truth}))

    assert outcome(80, 100, 100) == "hit"
    assert outcome(100, 400, 100) == "too much"
    assert outcome(100, 100, 400) == "too little"
    assert outcome(40, 100, 100) == "partly"
    assert outcome(2, 100, 100) == "elsewhere"
    assert outcome(0, 0, 100, "empty") == "nothing found"
    assert outcome(0, 0, 0, "empty") == "hit"
    assert outcome(0, 0, 100, "error") == "failed"
    assert outcome(0, 0, 100, "invalid") == "unreadable"
    assert outcome(50, 5000, 50) == "too much", "all of a small part, and a hundred times as much"


def test_groups_are_the_category_and_tags_that_say_something_else(run: Run) -> None:
    records = {
        id: Record({**record.row, "tags": {"same": record.category, "half": "first" if i < 10 else "second"}})
        for i, (id, record) in enumerate(run.records.items())
    }
    found = scores.by_group(replace(run, records=records))
    assert list(found) == ["category", "half"]
    assert found["half"]["first"].n == 10
    order = [group.giou for group in found["category"].values()]
    assert order == sorted(order), "worst first"
    assert sum(group.n for group in found["category"].values()) == 20


def test_a_group_of_which_nothing_is_scored_comes_last(run: Run) -> None:
    empty = {"status": "ok", "intersection": 0, "union": 0, "truth_pixels": 0, "prediction_pixels": 0}
    records = {
        id: Record({**record.row, "category": f"kind {i % 5}", **(empty if i % 5 == 2 else {})})
        for i, (id, record) in enumerate(run.records.items())
    }
    found = scores.by_group(replace(run, records=records), "affordance-r1")["category"]
    order = [group.giou for group in found.values()]
    assert np.isnan(order[-1])
    assert order[:-1] == sorted(order[:-1])


def test_another_protocol_may_be_asked_for(run: Run) -> None:
    assert scores.score(run).protocol == "strict"
    ragnet = scores.score(run, "ragnet")
    assert ragnet.giou == pytest.approx(scores.score(run).giou, abs=1e-4)
    assert ragnet.p50 != ragnet.p50
    assert scores.score(run, "affordance-r1").n_scored < len(run.records) == 20
