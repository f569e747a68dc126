"""What a run says of its experts."""

from __future__ import annotations

from a4agent.engine.stats import Stats
from a4agent.types import Usage


def test_a_line_an_expert_leaves_out_what_did_not_happen() -> None:
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
