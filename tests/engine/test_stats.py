"""What a run says of its experts."""

from __future__ import annotations

from a4agent.engine.stats import Stats
from a4agent.types import Affordance, Usage


def test_lines_leave_out_zero_counts() -> None:
    stats = Stats()
    stats.of("detector", "idle:1")
    asked = stats.of("vlm", "openai:x")
    asked.count_call(4, 1.25)
    asked.count_answer(Usage(cost=0.5))
    asked.count_retry()
    asked.count_failure(Usage(cost=0.25))
    stats.of("segmenter", "sam2:tiny").count_answer(Usage(cached=True))
    assert stats.lines() == [
        "vlm       openai:x: 4 asked in 1 calls, 1 retried, 1 failed, 1.2 s, $0.7500",
        "segmenter sam2:tiny: 1 saved",
    ]


def test_the_totals_are_the_sums_over_the_experts() -> None:
    stats = Stats()
    one, two = stats.of("vlm", "a:x"), stats.of("detector", "b:y")
    assert stats.of("vlm", "a:x") is one
    assert stats.of("detector", "a:x") is not one
    one.count_call(4, 1.0)
    two.count_call(2, 0.5)
    two.count_call(1, 0.5)
    one.count_answer(Usage(cost=0.5))
    two.count_answer(Usage(cost=0.25))
    two.count_answer(Usage(cost=None))
    one.count_answer(Usage(cached=True))
    two.count_failure(None)
    assert (stats.asked, stats.saved, stats.cost) == (7, 1, 0.75)
    assert (two.batches, two.seconds, two.unpriced, two.failures) == (2, 1.0, 1, 1)
    assert (one.unpriced, one.failures, one.retries) == (0, 0, 0)
    assert 0.0 <= stats.seconds < 3600.0


def test_samples_are_counted_by_status() -> None:
    stats = Stats()
    for status in ("ok", "ok", "empty"):
        stats.count_sample(Affordance("open", (8, 6), status=status))
    assert stats.samples == {"ok": 2, "empty": 1}
