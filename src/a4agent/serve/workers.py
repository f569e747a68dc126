"""One thread a worker takes jobs in the order they came; nobody else touches a model.

workers = Workers([agent], metrics)
job = workers.submit(lambda agent, tell: agent.predict(picture, "open it", on_stage=tell), tell=print)
job.future.result()
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

from a4agent.agent import A4Agent
from a4agent.serve.metrics import Metrics

Tell = Callable[[str, Any], None]
Work = Callable[[A4Agent, Tell], Any]


class Cancelled(Exception):
    """The caller has gone or its time is up; raised between two stages of its job."""


@dataclass(eq=False)
class Job:
    """Work in the queue. `future` has its result; `tell` hears from the worker's thread what happens on the way."""

    work: Work | None
    tell: Tell
    future: Future[Any] = field(default_factory=Future)
    submitted: float = field(default_factory=time.monotonic)
    cancelled: bool = False

    def cancel(self) -> None:
        """Stop before the next stage, and let go of the pictures."""
        self.cancelled = True
        self.work = None


class Workers:
    """Threads over agents. An agent may stand in the list more than once if its experts take as many calls at once."""

    def __init__(self, agents: Sequence[A4Agent], metrics: Metrics) -> None:
        self.agents = list(agents)
        self.metrics = metrics
        self._queue: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._open: list[Job] = []
        self._seconds = 1.0
        self._threads: list[threading.Thread] = []

    @property
    def count(self) -> int:
        return len(self.agents)

    def start(self) -> None:
        """Begin to work."""
        for number, agent in enumerate(self.agents):
            thread = threading.Thread(target=self._run, args=(agent,), name=f"a4-worker-{number}", daemon=True)
            thread.start()
            self._threads.append(thread)

    def alive(self) -> bool:
        """Whether every worker is running."""
        return bool(self._threads) and all(thread.is_alive() for thread in self._threads)

    def submit(self, work: Work, tell: Tell) -> Job:
        """Put work at the end of the queue."""
        job = Job(work, tell)
        with self._lock:
            self._open.append(job)
        self.metrics.waiting.inc()
        self._queue.put(job)
        return job

    def position(self, job: Job) -> int:
        """How many jobs will be taken before this one; 0 for the next and for one that was taken."""
        with self._lock:
            waiting = [other for other in self._open if not other.cancelled]
            return waiting.index(job) if job in waiting else 0

    def seconds_to_wait(self) -> float:
        """When a place is likely to be free, from how long the latest jobs took."""
        with self._lock:
            return self._seconds * (len(self._open) + 1) / max(self.count, 1)

    def close(self) -> None:
        """Finish what was submitted, then end the threads and close the agents."""
        for _ in self._threads:
            self._queue.put(None)
        for thread in self._threads:
            thread.join()
        for agent in {id(agent): agent for agent in self.agents}.values():
            agent.close()

    def _run(self, agent: A4Agent) -> None:
        while (job := self._queue.get()) is not None:
            with self._lock:
                self._open.remove(job)
            self.metrics.waiting.dec()
            self.metrics.waited(time.monotonic() - job.submitted)
            self.metrics.working.inc()
            started = time.monotonic()
            try:
                self._work(job, agent)
            finally:
                self.metrics.working.dec()
                self._seconds += 0.3 * (time.monotonic() - started - self._seconds)
                del job

    def _work(self, job: Job, agent: A4Agent) -> None:
        def tell(name: str, value: Any) -> None:
            if job.cancelled:
                raise Cancelled
            job.tell(name, value)

        work = job.work
        job.work = None
        try:
            if work is None:
                raise Cancelled
            job.future.set_result(work(agent, tell))
        except Exception as error:
            job.future.set_exception(error)
