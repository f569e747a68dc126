"""Scores in a terminal."""

from __future__ import annotations

from a4agent import metrics
from a4agent.cli.scores_text import lines


def test_counts_come_before_measures_and_what_is_not_defined_is_a_dash() -> None:
    rows = [metrics.Row(75, 100, "ok", 80, 95), metrics.Row(0, 50, "error", 50)]
    found = lines(metrics.score(rows, "ragnet"))
    assert found[0] == "n 2  scored 2  failed 1  empty truth 0  empty prediction 0  resized 0"
    assert found[1].startswith("gIoU     37.50   95% ")
    assert found[3].split() == ["P@50", "-", "95%", "-", "to", "-"]


def test_columns_stay_under_each_other_up_to_one_hundred() -> None:
    rows = [metrics.Row(100, 100, "ok", 100, 100), metrics.Row(50, 50, "ok", 50, 50)]
    perfect, middling = lines(metrics.score(rows)), lines(metrics.score([metrics.Row(30, 100, "ok", 100, 30)] * 2))
    assert [len(line) for line in perfect[1:]] == [len(line) for line in middling[1:]]
