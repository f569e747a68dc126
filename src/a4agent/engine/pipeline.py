"""Many samples at once: a bounded pool of threads takes queries as they come and gives answers as they are ready."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator

from a4agent.config import EngineSettings
from a4agent.engine.budget import Budget
from a4agent.engine.session import Session
from a4agent.engine.stats import Stats
from a4agent.engine.stop import Stop
from a4agent.protocols import Agent
from a4agent.types import Affordance, Given, Query, Trace

log = logging.getLogger("a4agent")

FINISHING = "finishing the samples in flight; interrupt again to leave at once"

Answered = tuple[int, Query, Affordance]


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

    A sample that fails is an answer of status "error" with the query's id. `queries` is read ahead of the answers
    given by twice the samples in flight at most, also in order. `given` tells what of a query is known already.
    The first Ctrl-C lets the samples in flight end, and is raised then; a second one is raised at once. `stats`
    is filled along the way.

    Raises:
        UserError: a key, a library or a model is missing, so that every sample would fail. This and the next
            two are raised when all samples in flight have been given.
        ProviderError: an expert was down for longer than `settings.outage_seconds`.
        BudgetExceeded: another sample does not fit into `settings.max_cost` or `max_seconds`.
    """
    remaining = iter(queries)
    session = Session(agent, settings or EngineSettings(), stats)
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
    """Threads that each take a query, answer it and take the next, until there is none or a reason to stop."""

    def __init__(
        self, session: Session, queries: Iterator[Query], given: Callable[[Query], Given | None] | None, stop: Stop
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
        """All answers, until the last thread has ended. Call `make_room` for each that was given to the caller."""
        for number in range(self._session.in_flight):
            threading.Thread(target=self._work, name=f"a4 sample {number}", daemon=True).start()
        running, woken, told = self._session.in_flight, False, False
        while running:
            if self._stop.reason is not None and not woken:
                woken = True
                self._wake_all()
            if self._stop.interrupted and not told:
                told = True
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
        """Another query may be taken."""
        self._room.release()

    def close(self) -> None:
        """Let go of the threads, also when nobody wants the rest of the answers."""
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
        except BaseException as error:  # raised to the caller of `run`, which is the one to handle it
            self._stop.because(error)
        finally:
            self._results.put(None)

    def _answer_one(self) -> bool:
        self._room.acquire()
        taken = self._take()
        if taken is None:
            return False
        self._budget.start()  # for a query that is there: a budget used up by the last one has refused nothing
        trace, started = None, time.monotonic()
        try:
            if self._stopped:
                return False
            number, query = taken
            given = self._given(query) if self._given else None
            affordance = self._session.predict(query, given, self._may_retry)
            trace = affordance.trace
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
