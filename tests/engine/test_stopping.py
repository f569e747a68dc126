"""A run begins no more samples after a signal, and only samples that fit its budget."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time

import numpy as np
import pytest

from a4agent import engine
from a4agent.agent import A4Agent
from a4agent.engine.stopping import UNTIL_PRICED, Budget, Stop
from a4agent.errors import BudgetExceeded
from a4agent.protocols import ChatAnswer, ChatRequest
from a4agent.stages.spotter import Spotter
from a4agent.stages.thinker import Thinker
from a4agent.testing import ScriptedDetector, ScriptedSegmenter, ScriptedVLM, output
from a4agent.types import Query, Step, Trace, Usage


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


def test_the_time_of_a_sample_follows_the_latest_ones_by_a_tenth(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr("a4agent.engine.stopping.time.monotonic", lambda: clock[0])
    budget = Budget(max_seconds=100.0)
    for seconds in [1.0] * 20 + [11.0]:
        budget.start()
        budget.finish(Trace(), seconds)
    for now, fits in ((97.9, True), (98.1, False)):  # 1 + a tenth of 10 seconds
        clock[0] = now
        if fits:
            budget.start()
        else:
            with pytest.raises(BudgetExceeded, match=r"another takes 2\.0 s"):
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


def test_a_sample_starts_up_to_the_last_second_and_none_that_waited_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr("a4agent.engine.stopping.time.monotonic", lambda: clock[0])
    budget = Budget(max_cost=1.0, max_seconds=10.0)
    clock[0] = 10.0
    for _ in range(UNTIL_PRICED):
        budget.start()
    refused: list[BudgetExceeded] = []

    def wait_and_start() -> None:
        try:
            budget.start()
        except BudgetExceeded as error:
            refused.append(error)

    waiting = threading.Thread(target=wait_and_start, daemon=True)
    waiting.start()
    while not budget._changed._waiters:  # type: ignore[attr-defined]
        time.sleep(0.002)
    clock[0] = 10.1
    budget.finish(cost(0.1), 0.0)
    waiting.join(5.0)
    assert "max_seconds = 10" in str(refused[0])


pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")


def test_the_first_reason_counts() -> None:
    stop = Stop()
    assert stop.reason is None
    stop.request_stop(ValueError("first"))
    stop.request_stop(ValueError("second"))
    assert str(stop.reason) == "first"


def test_the_first_interrupt_is_held_and_the_second_raised() -> None:
    with Stop() as stop:
        signal.raise_signal(signal.SIGINT)
        assert stop.interrupted
        assert isinstance(stop.reason, KeyboardInterrupt)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_interrupt_after_another_stop_still_counts_as_the_first() -> None:
    with Stop() as stop:
        stop.request_stop(ValueError("the key is refused"))
        signal.raise_signal(signal.SIGINT)
        assert stop.interrupted
        assert isinstance(stop.reason, ValueError)


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_other_requests_to_end_are_as_good_as_an_interrupt(name: str) -> None:
    number = getattr(signal, name)
    before = signal.signal(number, signal.SIG_DFL)
    try:
        with Stop() as stop:
            signal.raise_signal(number)
            assert isinstance(stop.reason, KeyboardInterrupt)
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(number)
        assert signal.getsignal(number) is signal.SIG_DFL
        signal.signal(number, signal.SIG_IGN)  # as nohup does
        with Stop() as stop:
            signal.raise_signal(number)
        assert stop.reason is None
    finally:
        signal.signal(number, before)


def test_a_handler_of_the_program_s_own_is_left_alone() -> None:
    heard: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: heard.append(number))
    try:
        with Stop() as stop:
            signal.raise_signal(signal.SIGINT)
        assert heard == [signal.SIGINT]
        assert not stop.interrupted
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_run_that_was_left_in_another_thread_swallows_no_interrupt() -> None:
    stop = Stop()
    stop.__enter__()
    try:
        leaving = threading.Thread(target=stop.__exit__, args=(None, None, None))
        leaving.start()
        leaving.join()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


INTERRUPTED = """
    import sys, time
    import numpy as np
    from a4agent import engine
    from a4agent.types import Query
    from a4agent.agent import A4Agent
    from a4agent.stages.spotter import Spotter
    from a4agent.testing import ScriptedDetector, ScriptedSegmenter

    agent = A4Agent(None, None, Spotter(ScriptedDetector(seconds=SECONDS, concurrency=2), ScriptedSegmenter()))
    queries = (Query(str(n), np.zeros((8, 8, 3), np.uint8), "open") for n in range(100_000))
    try:
        for query, affordance in engine.run(agent, queries, settings=engine.EngineSettings(in_flight=4)):
            print(affordance.status, flush=True)
    except KeyboardInterrupt:
        print("interrupted", len(agent.spotter.detector.requests), flush=True)
        sys.exit(130)
"""


def _start(seconds: float) -> subprocess.Popen[str]:
    code = textwrap.dedent(INTERRUPTED).replace("SECONDS", str(seconds))
    return subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=dict(os.environ)
    )


def test_the_first_interrupt_lets_what_is_in_flight_end() -> None:
    process = _start(0.05)
    assert process.stdout is not None
    first = process.stdout.readline()
    process.send_signal(signal.SIGINT)
    *done, last = [first, *process.stdout.read().splitlines()]
    _, err = process.communicate(timeout=30)
    assert process.returncode == 130, err
    assert last == f"interrupted {len(done)}"  # every sample that was begun has been given
    assert {line.strip() for line in done} == {"ok"}
    assert "interrupt again to leave at once" in err


STOPPING = """
    import os, signal, threading, time
    import numpy as np
    from a4agent import engine
    from a4agent.types import Query
    from a4agent.agent import A4Agent
    from a4agent.errors import CredentialError
    from a4agent.stages.spotter import Spotter
    from a4agent.testing import ScriptedDetector, ScriptedSegmenter

    def detect(request):
        if request.phrase == "q0":
            time.sleep(0.3)
            threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
            return CredentialError("the key has expired")
        time.sleep(0.8)
        return [[0, 0, 4, 4]]

    agent = A4Agent(None, None, Spotter(ScriptedDetector(detect, concurrency=4), ScriptedSegmenter()))
    queries = (Query(str(n), np.zeros((8, 8, 3), np.uint8), f"q{n}") for n in range(4))
    try:
        for query, affordance in engine.run(agent, queries, settings=engine.EngineSettings(in_flight=4)):
            print(affordance.status)
    except CredentialError:
        print("refused")
"""


def test_the_first_interrupt_of_a_run_that_is_stopping_lets_it_end_too() -> None:
    code = textwrap.dedent(STOPPING)
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert process.stdout.split() == ["ok", "ok", "ok", "refused"], process.stderr
    assert "interrupt again to leave at once" in process.stderr


def test_the_second_interrupt_leaves_at_once() -> None:
    process = _start(3.0)
    assert process.stdout is not None
    first = process.stdout.readline()
    process.send_signal(signal.SIGINT)
    time.sleep(0.4)
    process.send_signal(signal.SIGINT)
    rest, err = process.communicate(timeout=30)
    *done, last = [first, *rest.splitlines()]
    assert process.returncode == 130, err
    assert int(last.removeprefix("interrupted ")) > len(done)  # the samples in flight were left


def test_what_waits_for_the_budget_is_not_begun_after_an_interrupt() -> None:
    def chat(request: ChatRequest) -> ChatAnswer:
        time.sleep(0.1)
        if len(vlm.requests) == UNTIL_PRICED and next(once, False):
            signal.raise_signal(signal.SIGINT)
        time.sleep(0.4)
        return ChatAnswer(output("the handle"), usage=Usage(cost=0.01))

    once = iter([True])
    vlm = ScriptedVLM(chat, concurrency=8)
    agent = A4Agent(None, Thinker(vlm), Spotter(ScriptedDetector(), ScriptedSegmenter()))
    queries = [Query(str(number), np.full((8, 8, 3), number, np.uint8), "open") for number in range(8)]
    settings = engine.EngineSettings(in_flight=8, max_cost=1.0)
    with pytest.raises(KeyboardInterrupt):
        list(engine.run(agent, queries, settings=settings))
    assert len(vlm.requests) == UNTIL_PRICED
