"""Worker threads that take jobs in the order of their arrival; nothing else touches a model.

workers = Workers([agent], Counters())
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
from a4agent.errors import require
from a4agent.types import Affordance

Tell = Callable[[str, Any], None]
Work = Callable[[A4Agent, Tell], Any]
SECONDS = (0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 20, 40, 80, 160, 320)
METHODS = frozenset({"GET", "POST", "HEAD", "OPTIONS", "PUT", "DELETE", "PATCH"})
PATHS = frozenset(
    {"/", "/docs", "/v1/affordances", "/v1/affordances/batch", "/healthz", "/readyz", "/metrics", "/openapi.json"}
)


class Cancelled(Exception):
    """The caller is gone or its time is up; raised between two stages of a job."""


@dataclass(eq=False)
class Job:
    """Work in the queue. `future` gets its result; `tell` is called on the worker's thread with each event."""

    work: Work | None
    tell: Tell
    future: Future[Any] = field(default_factory=Future)
    submitted: float = field(default_factory=time.monotonic)
    cancelled: bool = False

    def cancel(self) -> None:
        """Stop before the next stage, and release the pictures."""
        self.cancelled = True
        self.work = None


class Workers:
    """One thread per agent. An agent may be listed more than once if its experts take as many calls at once."""

    def __init__(self, agents: Sequence[A4Agent], counters: Counters) -> None:
        self.agents = list(agents)
        self.counters = counters
        self._queue: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._open: list[Job] = []
        self._seconds = 1.0
        self._threads: list[threading.Thread] = []

    @property
    def count(self) -> int:
        return len(self.agents)

    def start(self) -> None:
        """Start the threads."""
        for number, agent in enumerate(self.agents):
            thread = threading.Thread(target=self._run, args=(agent,), name=f"a4-worker-{number}", daemon=True)
            thread.start()
            self._threads.append(thread)

    def alive(self) -> bool:
        """Whether every worker is running."""
        return bool(self._threads) and all(thread.is_alive() for thread in self._threads)

    def submit(self, work: Work, tell: Tell) -> Job:
        """Add work to the end of the queue."""
        job = Job(work, tell)
        with self._lock:
            self._open.append(job)
        self.counters.waiting.inc()
        self._queue.put(job)
        return job

    def position(self, job: Job) -> int:
        """How many jobs will be taken before this one; 0 for the next and for one that was taken."""
        with self._lock:
            waiting = [other for other in self._open if not other.cancelled]
            return waiting.index(job) if job in waiting else 0

    def seconds_to_wait(self) -> float:
        """Seconds until a place is likely to be free, estimated from the latest jobs."""
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
            self.counters.waiting.dec()
            self.counters.waited(time.monotonic() - job.submitted)
            self.counters.working.inc()
            started = time.monotonic()
            try:
                self._work(job, agent)
            finally:
                self.counters.working.dec()
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


class Counters:
    """What Prometheus reads from one server, in a registry of its own. No label holds a word of a request."""

    def __init__(self) -> None:
        prometheus = require("prometheus_client", extra="serve")
        prometheus.disable_created_metrics()
        self._text = prometheus.generate_latest
        self.content_type: str = prometheus.CONTENT_TYPE_LATEST
        self.registry = prometheus.CollectorRegistry()
        of = {"registry": self.registry}
        self._requests = prometheus.Counter("a4_requests", "HTTP answers", ["method", "path", "code"], **of)
        self._affordances = prometheus.Counter("a4_affordances", "Affordances by status", ["status"], **of)
        self._seconds = prometheus.Histogram(
            "a4_affordance_seconds", "Seconds of model calls for one affordance", buckets=SECONDS, **of
        )
        self._wait = prometheus.Histogram(
            "a4_queue_seconds", "Seconds a job waited for a worker", buckets=SECONDS, **of
        )
        self._stages = prometheus.Histogram(
            "a4_model_call_seconds", "Seconds of one model call", ["stage", "role"], buckets=SECONDS, **of
        )
        self._cost = prometheus.Counter("a4_cost_dollars", "Dollars known to be spent on model calls", **of)
        self.waiting = prometheus.Gauge("a4_queue_waiting", "Jobs that wait for a worker", **of)
        self.working = prometheus.Gauge("a4_queue_working", "Jobs being worked on", **of)

    def answered(self, method: str, path: str, code: int) -> None:
        """Count an HTTP answer; unknown methods and paths share the label "other", so that callers add none."""
        known_method, known_path = method if method in METHODS else "other", path if path in PATHS else "other"
        self._requests.labels(known_method, known_path, str(code)).inc()

    def waited(self, seconds: float) -> None:
        self._wait.observe(seconds)

    def predicted(self, affordance: Affordance) -> None:
        """Count one finished affordance, its model calls and what they cost."""
        self._affordances.labels(affordance.status).inc()
        self._seconds.observe(affordance.trace.seconds)
        self._cost.inc(affordance.trace.cost)
        for step in affordance.trace.steps:
            self._stages.labels(step.stage, step.role).observe(step.seconds)

    def text(self) -> bytes:
        """The exposition format."""
        return self._text(self.registry)
