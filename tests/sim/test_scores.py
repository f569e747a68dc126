"""The offline profile on a set made here, from the command line to the scores."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("onnxruntime", reason="needs the extra 'offline'")

from a4agent.cli.main import main


def _bench(made: Path, out: Path, capsys: pytest.CaptureFixture[str], *options: str) -> dict[str, float]:
    with pytest.raises(SystemExit) as stopped:
        main(["bench", "sim", "--data", str(made), "--profile", "offline", "--out", str(out), "--json", *options])
    assert stopped.value.code in (0, 1)  # 1: a sample failed, and counts as such
    return json.loads(capsys.readouterr().out)["scores"]


def test_the_offline_profile_is_scored_and_the_truth_scores_one(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    alone = _bench(made, tmp_path / "alone", capsys)
    assert alone["n"] == alone["n_scored"] == 24
    assert alone["n_empty_truth"] == 0
    assert 0 < alone["giou"] < 1
    told_the_mask = _bench(made, tmp_path / "told", capsys, "--oracle", "segmenter", "--limit", "8")
    assert told_the_mask["giou"] == 1
