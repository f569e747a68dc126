"""Many samples at once: a bounded pool of threads takes queries as they come and gives answers as they are ready."""

from __future__ import annotations

import logging
import queue
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from types import FrameType
from typing import Any

from a4agent.affordance import Affordance, Given, Query
from a4agent.agent import A4Agent
from a4agent.config import EngineSettings
from a4agent.engine.budget import Budget
from a4agent.engine.session import Session
from a4agent.engine.stats import Stats

log = logging.getLogger("a4agent")

Answered = tuple[int, Query, Affordance]


def run(
    agent: A4Agent,
    queries: Iterable[Query],
    *,
    settings: EngineSettings | None = None,
    ordered: bool = False,
    given: Callable[[Query], Given | None] | None = None,
    stats: Stats | None = None,
) -> Iterator[tuple[Query, Affordance]]:
    """Answer each query once, as the answers are ready or in the queries' order.

    A sample that fails is an answer of status "error" with the query's id. `queries` is read no further than
    the samples in flight. `given` tells what of a query is known already. The first Ctrl-C lets the samples
    in flight end, and is raised then; a second one is raised at once. `stats` is filled along the way.

    Raises:
        UserError: a key, a library or a model is missing, so that every sample would fail. This and the next
            two are raised when all samples in flight have been given.
        ProviderError: an expert was down for longer than `settings.outage_seconds`.
        BudgetExceeded: another sample does not fit into `settings.max_cost` or `max_seconds`.
    """
    session = Session(agent, settings or EngineSettings(), stats)
    pool = _Pool(session, iter(queries), given)
    with _Interrupts(pool):
        try:
            answers = pool.answers()
            for _, query, affordance in in_order(answers) if ordered else answers:
                yield query, affordance
                del query, affordance
        finally:
            pool.close()
            session.close()
    if pool.reason is not None:
        raise pool.reason


class _Pool:
    """Threads that each take a query, answer it and take the next, until there is none or a reason to stop."""

    def __init__(
        self, session: Session, queries: Iterator[Query], given: Callable[[Query], Given | None] | None
    ) -> None:
        self.reason: BaseException | None = None
        self._closed = False
        self._session = session
        self._queries = queries
        self._given = given
        self._budget = Budget(session.settings.max_cost, session.settings.max_seconds)
        self._taking = threading.Lock()
        self._taken = 0
        self._room = threading.Semaphore(2 * session.in_flight)
        self._results: queue.SimpleQueue[Answered | None] = queue.SimpleQueue()

    def stop(self, reason: BaseException) -> None:
        """Start no more samples."""
        self.reason = self.reason or reason

    def answers(self) -> Iterator[Answered]:
        """All answers, until the last thread has ended."""
        for number in range(self._session.in_flight):
            threading.Thread(target=self._work, name=f"a4 sample {number}", daemon=True).start()
        running, told = self._session.in_flight, False
        while running:
            if self.reason is not None and not told:
                told = True
                self._wake_all()
                if isinstance(self.reason, KeyboardInterrupt):
                    log.warning("finishing the samples in flight; interrupt again to leave at once")
            try:
                answered = self._results.get(timeout=0.2)
            except queue.Empty:
                continue
            if answered is None:
                running -= 1
                continue
            yield answered
            del answered
            self._room.release()

    def close(self) -> None:
        """Let go of the threads, also when nobody wants the rest of the answers."""
        self._closed = True
        self._wake_all()

    def _wake_all(self) -> None:
        self._room.release(self._session.in_flight)

    def _work(self) -> None:
        try:
            while self._answer_one():
                pass
        except BaseException as error:  # raised to the caller of `run`, which is the one to handle it
            self.stop(error)
        finally:
            self._results.put(None)

    def _answer_one(self) -> bool:
        self._room.acquire()
        if self.reason is not None or self._closed:
            return False
        self._budget.start()
        trace, started = None, time.monotonic()
        try:
            taken = self._take()
            if taken is None:
                return False
            number, query = taken
            given = self._given(query) if self._given else None
            affordance = self._session.predict(query, given)
            trace = affordance.trace
            self._results.put((number, query, affordance))
            return True
        finally:
            self._budget.finish(trace, time.monotonic() - started)

    def _take(self) -> tuple[int, Query] | None:
        with self._taking:
            if self.reason is not None or self._closed:
                return None
            query = next(self._queries, None)
            if query is None:
                self._queries = iter(())
                self._wake_all()
                return None
            self._taken += 1
            return self._taken - 1, query


def in_order(answers: Iterator[Answered]) -> Iterator[Answered]:
    """The same answers by number; those behind a gap, which a stopped run may leave, come last."""
    waiting: dict[int, Answered] = {}
    wanted = 0
    for answered in answers:
        waiting[answered[0]] = answered
        del answered
        while wanted in waiting:
            yield waiting.pop(wanted)
            wanted += 1
    for number in sorted(waiting):
        yield waiting[number]


class _Interrupts:
    """While a run goes on, the first Ctrl-C asks it to stop and the second raises KeyboardInterrupt.

    Only where Python's own handler is in place, which is in the main thread of a program that has no other.
    """

    def __init__(self, pool: _Pool) -> None:
        self._pool = pool
        self._installed = False

    def __enter__(self) -> None:
        ours = threading.current_thread() is threading.main_thread()
        if ours and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, self._interrupted)
            self._installed = True

    def __exit__(self, *_: Any) -> None:
        if self._installed and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def _interrupted(self, number: int, frame: FrameType | None) -> None:
        if self._pool.reason is not None:
            raise KeyboardInterrupt
        self._pool.stop(KeyboardInterrupt())
