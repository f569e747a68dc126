"""Damaged lines: each is one sentence with its line, and the lines around it stay."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from a4agent.errors import DataError
from a4agent.runs.line import problem_of
from a4agent.runs.store import Run, read_records


def without(row: Any, *path: str) -> Any:
    """The same without the field at `path`."""
    first, *rest = path
    return {key: without(value, *rest) if key == first else value for key, value in row.items() if key != first or rest}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda row: without(row, "mask"), "mask: Field required"),
        (lambda row: without(row, "truth", "counts"), "truth.counts: Field required"),
        (lambda row: without(row, "trace"), "trace: Field required"),
        (lambda row: {**row, "trace": [{}]}, "trace.0.stage: Field required"),
        (lambda row: {**row, "intersection": 3, "union": 2}, "intersection 3 is larger than union 2"),
        (lambda row: {**row, "intersection": -1}, "intersection: Input should be greater than or equal to 0"),
        (lambda row: {**row, "status": "fine"}, "status: Input should be 'ok'"),
        (lambda row: {**row, "size_wh": [1]}, "size_wh: List should have at least 2 items"),
        (lambda row: {**row, "boxes_xyxy": [[1, 2, 3]]}, "boxes_xyxy.0: List should have at least 4 items"),
        (lambda row: {**row, "confidence": 1.5}, "confidence: Input should be less than or equal to 1"),
        (lambda row: {**row, "pictures": ["x"]}, "pictures: Input should be a valid dictionary"),
        (lambda row: {**row, "schema": 99}, "schema 99, and this version reads"),
        (lambda _: ["a", "list"], "not a JSON object"),
    ],
)
def test_each_damage_is_named(run: Run, tmp_path: Path, change: Any, reason: str) -> None:
    rows = [dict(record.row) for record in run.records.values()][:3]
    assert [problem_of(row) for row in rows] == ["", "", ""]
    path = tmp_path / "samples.jsonl"
    path.write_text("".join(json.dumps(row) + "\n" for row in (rows[0], change(rows[1]), rows[2])))
    with pytest.raises(DataError, match="line 2 of") as raised:
        read_records(path)
    assert reason in str(raised.value)
    assert "\n" not in str(raised.value)


def test_nested_beyond_reason_is_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "samples.jsonl"
    path.write_text("[" * 200_000 + "\n")
    with pytest.raises(DataError, match=r"line 1 of .* is damaged"):
        read_records(path)


def test_an_unfinished_last_line_is_ignored(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "samples.jsonl"
    lines = [json.dumps(record.row) for record in run.records.values()]
    path.write_text(lines[0] + "\n" + lines[1][:-40])
    assert len(read_records(path)) == 1
