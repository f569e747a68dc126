"""A sample starts only if it fits."""

from __future__ import annotations

import threading
import time

import pytest

from a4agent.engine.budget import UNTIL_PRICED, Budget
from a4agent.errors import BudgetExceeded
from a4agent.types import Step, Trace


def cost(dollars: float, *, cached: bool = False) -> Trace:
    return Trace((Step("thinker", "vlm", "x", cost=dollars, cached=cached),))


def test_without_limits_everything_starts() -> None:
    budget = Budget()
    for _ in range(1000):
        budget.start()


def test_few_start_until_the_first_one_ends_and_then_what_fits() -> None:
    budget = Budget(max_cost=1.0)
    started = threading.Semaphore(0)

    def start() -> None:
        budget.start()
        started.release()

    threads = [threading.Thread(target=start, daemon=True) for _ in range(14)]
    for thread in threads:
        thread.start()
    time.sleep(0.1)
    running = 0
    while started.acquire(blocking=False):
        running += 1
    assert running == UNTIL_PRICED
    budget.finish(cost(0.1), 1.0)
    time.sleep(0.1)
    while started.acquire(blocking=False):
        running += 1
    assert running == 10  # one has ended, nine run: all of the dollar is spoken for
    for _ in range(9):
        budget.finish(cost(0.05), 1.0)
    time.sleep(0.1)
    while started.acquire(blocking=False):
        running += 1
    assert running == 10 + 4  # 0.55 is spent, and the dearest took 0.1
    for _ in range(4):
        budget.finish(cost(0.1), 1.0)
    with pytest.raises(BudgetExceeded, match=r"max_cost = 1 .*0\.9500 spent on 14 samples"):
        budget.start()


def test_answers_from_the_cache_tell_nothing_about_the_price() -> None:
    budget = Budget(max_cost=1.0)
    for _ in range(100):
        budget.start()
        budget.finish(cost(0.5, cached=True), 1.0)
    budget.start()
    budget.finish(cost(0.9), 1.0)
    with pytest.raises(BudgetExceeded):
        budget.start()


def test_no_money_starts_nothing() -> None:
    with pytest.raises(BudgetExceeded):
        Budget(max_cost=0.0).start()


def test_a_sample_that_would_end_late_does_not_start() -> None:
    budget = Budget(max_seconds=10.0)
    budget.start()
    budget.finish(cost(0.0), 60.0)
    with pytest.raises(BudgetExceeded, match=r"another takes 60"):
        budget.start()


def test_a_retry_is_expected_to_cost_what_its_sample_has() -> None:
    budget = Budget(max_cost=1.0)
    budget.start()
    assert budget.may_retry(cost(0.5))  # 0.5 more, at most 1.0 in all
    assert not budget.may_retry(cost(0.6))
    budget.finish(cost(1.0), 1.0)
    free = Budget(max_cost=0.5)
    free.start()
    assert free.may_retry(cost(0.4, cached=True))


def test_a_retry_leaves_room_for_the_samples_beside_it() -> None:
    budget = Budget(max_cost=1.0)
    budget.start()
    budget.start()
    assert not budget.may_retry(cost(0.3))  # two samples of 0.6
    assert budget.may_retry(cost(0.25))
    assert budget.may_retry(cost(0.25))
    assert not budget.may_retry(cost(0.26))


def test_no_retry_ends_late() -> None:
    slow = Trace((Step("thinker", "vlm", "x", seconds=30.0),))
    assert not Budget(max_seconds=20.0).may_retry(slow)
    assert Budget(max_seconds=40.0).may_retry(slow)
