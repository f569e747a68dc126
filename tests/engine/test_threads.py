"""One function over many items: in order, a bounded number ahead, and the error at its own item's turn."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest

from a4agent.engine.threads import ordered_map


def test_results_come_in_order_however_long_each_takes() -> None:
    def slow_first(number: int) -> int:
        time.sleep(0.02 if number % 4 == 0 else 0)
        return number * 2

    assert list(ordered_map(slow_first, range(40), workers=4)) == [2 * number for number in range(40)]


def test_no_more_is_taken_than_is_being_worked_on() -> None:
    taken = 0

    def items() -> Iterator[int]:
        nonlocal taken
        for number in range(1000):
            taken += 1
            yield number

    results = ordered_map(lambda number: number, items(), workers=3)

    assert next(results) == 0
    assert taken == 6
    results.close()
    assert taken == 6


def test_threads_are_used_and_end() -> None:
    barrier = threading.Barrier(3, timeout=5)

    assert len(list(ordered_map(lambda _: barrier.wait(), range(3), workers=3))) == 3
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("a4-map")]


def test_an_error_comes_at_its_turn() -> None:
    results = ordered_map(lambda number: 6 // (3 - number), range(10), workers=2)

    assert [next(results) for _ in range(3)] == [2, 3, 6]
    with pytest.raises(ZeroDivisionError):
        next(results)
    assert list(ordered_map(str, [], workers=2)) == []
