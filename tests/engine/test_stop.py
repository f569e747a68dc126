"""The first Ctrl-C is a reason to stop, the second is raised; what was there before is put back."""

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
from a4agent.engine.budget import UNTIL_PRICED
from a4agent.engine.stop import Stop
from a4agent.protocols import ChatAnswer, ChatRequest
from a4agent.stages.spotter import Spotter
from a4agent.stages.thinker import Thinker
from a4agent.testing import ScriptedDetector, ScriptedSegmenter, ScriptedVLM, output
from a4agent.types import Query, Usage

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")


def test_the_first_reason_counts() -> None:
    stop = Stop()
    assert stop.reason is None
    stop.because(ValueError("first"))
    stop.because(ValueError("second"))
    assert str(stop.reason) == "first"


def test_the_first_interrupt_is_held_and_the_second_raised() -> None:
    with Stop() as stop:
        signal.raise_signal(signal.SIGINT)
        assert stop.interrupted
        assert isinstance(stop.reason, KeyboardInterrupt)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_interrupt_of_a_run_that_stops_for_another_reason_is_the_first_all_the_same() -> None:
    with Stop() as stop:
        stop.because(ValueError("the key is refused"))
        signal.raise_signal(signal.SIGINT)
        assert stop.interrupted
        assert isinstance(stop.reason, ValueError)


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
    process.stdout.readline()
    process.send_signal(signal.SIGINT)
    time.sleep(0.4)
    started = time.monotonic()
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=30)
    assert process.returncode == 130
    assert time.monotonic() - started < 2.0


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
