"""Many samples at once: a bounded pool of threads takes queries as they come and yields answers as they are ready."""

from __future__ import annotations

import logging
import os
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from a4agent.config import EngineSettings
from a4agent.engine.session import EngineSession, Unfinished
from a4agent.engine.stats import Stats
from a4agent.engine.stopping import Budget, Stop
from a4agent.errors import BudgetExceeded
from a4agent.protocols import Agent
from a4agent.types import Affordance, Given, Query, Trace

log = logging.getLogger("a4agent")

FINISHING = "finishing the samples in flight; interrupt again to leave at once"

Answered = tuple[int, Query, Affordance]
ItemT = TypeVar("ItemT")
ResultT = TypeVar("ResultT")


def run(
    agent: Agent,
    queries: Iterable[Query],
    *,
    settings: EngineSettings | None = None,
    ordered: bool = False,
    given: Callable[[Query], Given | None] | None = None,
    stats: Stats | None = None,
) -> Iterator[tuple[Query, Affordance]]:
    """Answer each query once, as the answers are ready or in the queries' order.

    A sample that fails is an answer of status "error" with the query's id. At most 2 x in_flight queries are read
    ahead, also in order. `given` returns what is already known for a query; `stats` is filled along the way.
    The first Ctrl-C (or SIGTERM, SIGHUP) lets the samples in flight finish, but those that wait before a retry, and
    raises KeyboardInterrupt then; a second one raises it at once.

    Raises:
        UserError: a key, library, model or price is missing, so that every sample would fail. This and the next
            two are raised when the samples in flight have finished.
        ProviderError: an expert was down for longer than `settings.outage_seconds`.
        BudgetExceeded: another sample does not fit into `settings.max_cost` or `max_seconds`.
    """
    remaining = iter(queries)
    session = EngineSession(agent, settings or EngineSettings(), stats)
    with Stop() as stop:
        pool = _Pool(session, remaining, given, stop)
        try:
            answers = pool.answers()
            for _, query, affordance in in_order(answers) if ordered else answers:
                yield query, affordance
                del query, affordance
                pool.make_room()
        finally:
            pool.close()
            session.close()
    if stop.reason is not None:
        raise stop.reason


class _Pool:
    """Threads that each take a query, answer it and take the next, until there are none or the run stops."""

    def __init__(
        self,
        session: EngineSession,
        queries: Iterator[Query],
        given: Callable[[Query], Given | None] | None,
        stop: Stop,
    ) -> None:
        self._session = session
        self._queries = queries
        self._given = given
        self._stop = stop
        self._closed = False
        self._budget = Budget(session.settings.max_cost, session.settings.max_seconds)
        self._taking = threading.Lock()
        self._taken = 0
        self._room = threading.Semaphore(2 * session.in_flight)
        self._results: queue.SimpleQueue[Answered | None] = queue.SimpleQueue()

    def answers(self) -> Iterator[Answered]:
        """All answers, until the last thread has ended. Call `make_room` for each one passed on."""
        for number in range(self._session.in_flight):
            threading.Thread(target=self._work, name=f"a4 sample {number}", daemon=True).start()
        running, woken, warned = self._session.in_flight, False, False
        while running:
            if self._stop.reason is not None and not woken:
                woken = True
                self._wake_all()
                if not isinstance(self._stop.reason, BudgetExceeded):
                    self._session.end_waits()
            if self._stop.interrupted and not warned:
                warned = True
                log.warning(FINISHING)
            try:
                answered = self._results.get(timeout=0.2)
            except queue.Empty:
                continue
            if answered is None:
                running -= 1
                continue
            yield answered
            del answered

    def make_room(self) -> None:
        """Let another query be read."""
        self._room.release()

    def close(self) -> None:
        """Let the threads end, also when the caller has left."""
        self._closed = True
        self._wake_all()

    def _wake_all(self) -> None:
        self._room.release(self._session.in_flight)

    @property
    def _stopped(self) -> bool:
        return self._closed or self._stop.reason is not None

    def _work(self) -> None:
        try:
            while self._answer_one():
                pass
        except Unfinished:
            pass
        except BaseException as error:  # raised to the caller of `run`
            self._stop.request_stop(error)
        finally:
            self._results.put(None)

    def _answer_one(self) -> bool:
        self._room.acquire()
        taken = self._take()
        if taken is None:
            return False
        self._budget.start()  # after a query was taken: without one, a used-up budget is no reason to stop
        trace, started = None, time.monotonic()
        try:
            if self._stopped:
                return False
            number, query = taken
            given = self._given(query) if self._given else None
            affordance = self._session.predict(query, given, self._may_retry)
            trace = affordance.trace
            if self._session.uncounted is not None:
                self._stop.request_stop(self._session.uncounted)
            self._results.put((number, query, affordance))
            return True
        finally:
            self._budget.finish(trace, time.monotonic() - started)

    def _may_retry(self, trace: Trace) -> bool:
        """Whether a sample may ask a stage again: not beyond the budget, and not when the run is to end."""
        return not self._stopped and self._budget.may_retry(trace)

    def _take(self) -> tuple[int, Query] | None:
        with self._taking:
            if self._stopped:
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


def ordered_map(
    function: Callable[[ItemT], ResultT], items: Iterable[ItemT], workers: int | None = None
) -> Iterator[ResultT]:
    """`map` on `workers` threads (None: one a core); reads at most twice as many items ahead as there are threads.

    Results come in the items' order; the first exception is raised at its item's turn.
    """
    workers = workers or os.cpu_count() or 1
    ahead: deque[Future[ResultT]] = deque()
    with ThreadPoolExecutor(workers, thread_name_prefix="a4-map") as pool:
        try:
            for item in items:
                ahead.append(pool.submit(function, item))
                if len(ahead) >= 2 * workers:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()
        finally:
            for future in ahead:
                future.cancel()
