"""Waits grow and differ; an expert that is down is probed by one call at a time, and given up in the end."""

from __future__ import annotations

import threading
import time
from contextlib import suppress

import pytest

from a4agent.engine.retry import FAILURES_TO_OPEN, LONGEST_WAIT, Breaker, Pace, backoff, fresh
from a4agent.errors import CredentialError, ProviderError, ProviderUnavailable, RateLimited


def test_waits_double_are_bounded_and_differ() -> None:
    error = ProviderUnavailable("down")
    for failures in range(1, 12):
        waits = [backoff(failures, 0.5, error, 120.0) for _ in range(50)]
        highest = min(0.5 * 2 ** (failures - 1), LONGEST_WAIT)
        assert highest / 2 <= min(waits) <= max(waits) <= highest
        assert len(set(waits)) > 10


def test_the_provider_s_own_wait_is_kept_up_to_the_limit() -> None:
    assert backoff(1, 0.01, RateLimited("slow down", retry_after=7.0), 120.0) == 7.0
    assert backoff(1, 100.0, RateLimited("slow down", retry_after=7.0), 120.0) > 7.0
    assert backoff(1, 0.01, RateLimited("slow down", retry_after=100_000.0), 120.0) == 120.0
    assert backoff(1, 8.0, RateLimited("slow down", retry_after=100_000.0), 0.0) <= 8.0


def test_a_fresh_error_keeps_its_class_and_fields_but_not_its_traceback() -> None:
    try:
        raise RateLimited("slow down", 3.0) from ValueError("why")
    except RateLimited as raised:
        error = raised
    twin = fresh(error)
    assert isinstance(twin, RateLimited)
    assert twin is not error
    assert twin.retry_after == 3.0
    assert str(twin) == "slow down"
    assert isinstance(twin.__cause__, ValueError)
    assert twin.__traceback__ is None


def test_an_error_whose_constructor_wants_more_is_shared() -> None:
    class Odd(ProviderUnavailable):
        def __init__(self, code: int, *, detail: str) -> None:
            super().__init__(f"{code}: {detail}")

    odd = Odd(503, detail="down")
    assert fresh(odd) is odd


def trip(breaker: Breaker) -> None:
    """Ten failures in a row, as documented."""
    assert FAILURES_TO_OPEN == 10
    for _ in range(FAILURES_TO_OPEN):
        breaker.enter()
        breaker.failed(ProviderUnavailable("down"))


def test_a_few_failures_change_nothing() -> None:
    breaker = Breaker("x", pause=60.0)
    for _ in range(50):
        for _ in range(FAILURES_TO_OPEN - 1):
            breaker.failed(ProviderUnavailable("down"))
        breaker.succeeded()
    assert not breaker.is_open
    breaker.enter()


def test_one_call_finds_out_whether_the_expert_is_back() -> None:
    breaker = Breaker("x", pause=0.2)
    trip(breaker)
    assert breaker.is_open
    entered: list[float] = []

    def call() -> None:
        breaker.enter()
        entered.append(time.monotonic())

    started = time.monotonic()
    threads = [threading.Thread(target=call, daemon=True) for _ in range(5)]
    for thread in threads:
        thread.start()
    time.sleep(0.3)
    assert len(entered) == 1
    assert entered[0] - started >= 0.15
    breaker.failed(ProviderUnavailable("still down"))  # a pause of 0.4 s now
    time.sleep(0.1)
    assert len(entered) == 1
    time.sleep(0.5)
    assert len(entered) == 2
    breaker.succeeded()
    for thread in threads:
        thread.join(2.0)
    assert len(entered) == 5
    assert not breaker.is_open


def test_an_expert_that_stays_down_ends_the_run_with_the_reason() -> None:
    breaker = Breaker("openai:gpt-4o", pause=0.01, outage_seconds=0.05)
    trip(breaker)
    for _ in range(5):  # pauses of 0.01, 0.02, 0.04, 0.08 s
        with suppress(ProviderError):
            breaker.enter()
            breaker.failed(ProviderUnavailable("connection refused"))
    with pytest.raises(ProviderError, match=r"openai:gpt-4o has failed .*: connection refused") as caught:
        breaker.enter()
    assert caught.value.fatal
    assert not ProviderError.fatal


def test_a_wait_that_one_request_was_told_holds_back_no_other() -> None:
    breaker = Breaker("x")
    breaker.failed(RateLimited("slow down", retry_after=60.0))
    started = time.monotonic()
    breaker.enter()
    assert time.monotonic() - started < 10.0


def test_waits_can_be_ended_while_calls_that_need_not_wait_go_on() -> None:
    breaker = Breaker("x", pause=60.0)
    breaker.end_waits(ProviderError("stopped"))
    breaker.enter()
    trip(breaker)
    with pytest.raises(ProviderError, match="stopped"):
        breaker.enter()

    waiting = Breaker("x", pause=60.0)
    trip(waiting)
    threading.Timer(0.1, waiting.end_waits, (ProviderError("stopped"),)).start()
    with pytest.raises(ProviderError, match="stopped"):
        waiting.enter()


def test_what_was_given_up_stays_so() -> None:
    breaker = Breaker("x")
    breaker.give_up(CredentialError("refused"))
    breaker.succeeded()
    for _ in range(2):
        with pytest.raises(CredentialError, match="refused"):
            breaker.enter()


def test_the_pace_finds_the_limit_and_stays_near_it() -> None:
    pace, limit = Pace(32), 6
    seen: list[int] = []
    refused = 0
    for _ in range(400):  # rounds of calls that are made together
        started = time.monotonic()
        calls = pace.calls
        seen.append(calls)
        for call in range(calls):
            if call < limit:
                pace.succeeded()
            else:
                refused += 1
                pace.limited(started)
    assert seen[0] == 32
    assert all(calls <= limit + 1 for calls in seen[10:])
    assert sum(seen[10:]) / len(seen[10:]) > 0.75 * limit
    assert refused < 0.1 * sum(seen) + 100


def test_the_pace_is_what_the_expert_can_take_when_nothing_is_refused() -> None:
    pace = Pace(3)
    for _ in range(100):
        pace.succeeded()
    assert pace.calls == 3
    for _ in range(100):
        pace.limited(time.monotonic())
    assert pace.calls == 1
    for _ in range(100):
        pace.succeeded()
    assert pace.calls == 3


def test_the_pace_returns_quickly_to_nine_tenths_of_the_limit_and_slowly_from_there() -> None:
    pace = Pace(20)
    pace.limited(time.monotonic())
    assert pace.calls == 14
    rounds = 0
    while pace.calls < 18:
        pace.succeeded()
        rounds += 1
    assert rounds < 80  # one more call in flight for each round of 14 to 17 calls
    while pace.calls < 19:
        pace.succeeded()
        rounds += 1
    assert rounds > 140  # one more in five rounds


def test_the_shortest_wait_is_the_one_that_was_set() -> None:
    assert backoff(1, 0.001, ProviderUnavailable("down"), 120.0) <= 0.001


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr("a4agent.engine.retry.time.monotonic", lambda: now[0])
    return now


def waits_until(breaker: Breaker, clock: list[float]) -> float:
    """The first full second from now at which a call may be made; the breaker must raise instead of waiting."""
    for seconds in range(100):
        with suppress(ProviderError):
            breaker.enter()
            return float(seconds)
        clock[0] += 1.0
    raise AssertionError("no call was let through")


def test_a_call_under_way_when_the_expert_went_down_lengthens_no_pause(clock: list[float]) -> None:
    breaker = Breaker("x", pause=8.0)
    trip(breaker)
    clock[0] += 5.0
    breaker.failed(ProviderUnavailable("down"))
    breaker.end_waits(ProviderError("would wait"))
    assert waits_until(breaker, clock) == 3.0


def test_pauses_double_up_to_the_longest_and_start_anew_after_an_answer(clock: list[float]) -> None:
    breaker = Breaker("x", pause=8.0, outage_seconds=1000.0)
    breaker.end_waits(ProviderError("would wait"))
    trip(breaker)
    pauses: list[float] = []
    for _ in range(4):
        pauses.append(waits_until(breaker, clock))
        breaker.failed(ProviderUnavailable("down"))
    assert pauses == [8.0, 16.0, LONGEST_WAIT, LONGEST_WAIT]
    assert waits_until(breaker, clock) == LONGEST_WAIT
    breaker.succeeded()
    trip(breaker)
    assert waits_until(breaker, clock) == 8.0


def test_an_outage_is_measured_from_the_failure_that_began_it(clock: list[float]) -> None:
    breaker = Breaker("x", pause=8.0, outage_seconds=24.0)
    breaker.end_waits(ProviderError("would wait"))
    trip(breaker)
    waits_until(breaker, clock)
    breaker.failed(ProviderUnavailable("down"))  # after 8 s
    waits_until(breaker, clock)
    breaker.failed(ProviderUnavailable("down"))  # after 24 s
    with pytest.raises(ProviderError, match=r"x has failed 12 times in a row for 24 s"):
        breaker.enter()
