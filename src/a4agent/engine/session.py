"""An agent made fit for many samples at once: its experts stand behind queues, a cache and a breaker.

`Session.predict` may be called from any number of threads; stage code stays plain and sequential. A request
goes: cache -> an identical request in flight -> the expert's queue -> again after a pause, if that may help.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import replace
from typing import Any, cast

from a4agent.config import EngineSettings
from a4agent.engine.cache import Cache, default_folder
from a4agent.engine.dispatch import Dispatcher, Job
from a4agent.engine.keys import Keys
from a4agent.engine.retry import Breaker, backoff, fresh
from a4agent.engine.stats import Stats
from a4agent.errors import A4Error, BudgetExceeded, ProviderError
from a4agent.protocols import (
    VERBS,
    Agent,
    Answer,
    ChatAnswer,
    ChatRequest,
    DetectRequest,
    EditAnswer,
    EditRequest,
    Expert,
    Request,
    Segmentation,
    SegmentRequest,
    with_usage,
)
from a4agent.redaction import redact
from a4agent.types import Affordance, Detection, Given, Query, Trace

MOST_IN_FLIGHT = 128


class _Sample(threading.local):
    """What is known of the sample that a thread is at."""

    seconds_left: float | None = None
    image: Any = None
    chats: tuple[str, ...] = ()


class Session:
    """The experts of one run behind their queues. Close it when the run is over; the agent stays open."""

    def __init__(self, agent: Agent, settings: EngineSettings, stats: Stats | None = None) -> None:
        self.settings = settings
        self.stats = stats or Stats()
        folder = settings.cache_dir or default_folder()
        self.cache = None if settings.cache == "off" else Cache(folder, settings.cache_gb * 1e9)
        self.keys = Keys()
        self.sample = _Sample()
        self.closing = threading.Event()
        self.in_flight = settings.in_flight or _enough_in_flight(agent)
        self._queued = [QueuedExpert(expert, self) for expert in agent.experts()]
        twins = {id(queued.expert): queued for queued in self._queued}
        self._agent = agent.with_experts(lambda expert: twins[id(expert)])
        segmenter = agent.segmenter
        self._segmenter = None if segmenter is None else twins[id(segmenter)]
        if settings.max_sample_seconds is not None:
            threading.Thread(target=self._watch, args=(settings.max_sample_seconds,), daemon=True).start()

    def predict(
        self, query: Query, given: Given | None = None, may_retry: Callable[[Trace], bool] | None = None
    ) -> Affordance:
        """The answer to a query; whatever is wrong with this sample alone is a status and an error text.

        Raises:
            A4Error: what would go wrong with every other sample as well (`error.fatal`).
        """
        self.sample.seconds_left = self.settings.max_sample_seconds
        self.sample.chats = ()
        try:
            answer = self._agent.predict(query.image, query.instruction, given=given, may_retry=may_retry)
        except Exception as error:
            if isinstance(error, A4Error) and (error.fatal or isinstance(error, BudgetExceeded)):
                raise
            reason = redact(f"{type(error).__name__}: {error}")
            answer = Affordance(str(query.instruction), (0, 0), status="error", error=reason)
        finally:
            if self._segmenter and self.sample.image is not None:
                self._segmenter.dispatcher.forget(self.sample.image)
            self.sample.image = None
        if answer.status == "invalid" and self.settings.cache == "write":
            self._forget_chats()
        answer = replace(answer, id=query.id)
        self.stats.count_sample(answer)
        return answer

    def missed(self, request: Request) -> None:
        """A request of this thread's sample has to be asked. The first one lets the image encoding start.

        A sample whose answers are all in the cache needs no encoding.
        """
        if self.sample.image is not None or self._segmenter is None:
            return
        images = request.images[:1] if isinstance(request, ChatRequest) else (request.image,)
        for image in images:
            self.sample.image = image
            if not isinstance(request, SegmentRequest):
                self._segmenter.dispatcher.prepare(image)

    def _forget_chats(self) -> None:
        """Of a sample that came to nothing because of what a model said, keep no saying: the next run may do better."""
        for key in self.sample.chats:
            if self.cache is not None:
                self.cache.remove(key)

    def close(self) -> None:
        """End the threads that are idle; calls that are being made end on their own."""
        self.closing.set()
        for queued in self._queued:
            queued.dispatcher.close()

    def _watch(self, limit: float) -> None:
        while not self.closing.wait(min(max(limit / 20, 0.01), 1.0)):
            for queued in self._queued:
                queued.dispatcher.abandon_overdue(limit)


class QueuedExpert:
    """Stands in for an expert and looks just like it to a stage."""

    def __init__(self, expert: Expert, session: Session) -> None:
        settings = session.settings
        self.expert = expert
        self.id = expert.id
        self.max_batch = expert.max_batch
        self.concurrency = expert.concurrency
        self.stats = session.stats.of(_role(expert), expert.id)
        breaker = Breaker(expert.id, settings.retry_wait * 2, settings.outage_seconds)
        self.dispatcher = Dispatcher(expert, breaker, self.stats, settings.batch_wait_ms / 1000)
        self._session = session
        self._lock = threading.Lock()
        self._asking: dict[str, Future[Answer | A4Error]] = {}

    def fingerprint(self) -> Any:
        return self.expert.fingerprint()

    def close(self) -> None:
        return None

    def chat(self, requests: Sequence[ChatRequest]) -> list[ChatAnswer | A4Error]:
        return cast("list[ChatAnswer | A4Error]", [self._answer(request) for request in requests])

    def edit(self, requests: Sequence[EditRequest]) -> list[EditAnswer | A4Error]:
        return cast("list[EditAnswer | A4Error]", [self._answer(request) for request in requests])

    def detect(self, requests: Sequence[DetectRequest]) -> list[Detection | A4Error]:
        return cast("list[Detection | A4Error]", [self._answer(request) for request in requests])

    def segment(self, requests: Sequence[SegmentRequest]) -> list[Segmentation | A4Error]:
        return cast("list[Segmentation | A4Error]", [self._answer(request) for request in requests])

    def _answer(self, request: Request) -> Answer | A4Error:
        cache = self._session.cache
        if cache is None:
            return self._asked(request)
        key = self._session.keys.of(self.expert, request)
        if isinstance(request, ChatRequest):
            self._session.sample.chats += (key,)
        while True:
            mine: Future[Answer | A4Error] = Future()
            with self._lock:
                elsewhere = self._asking.setdefault(key, mine)
            if elsewhere is mine:
                return self._first(key, mine, request, cache)
            answer = elsewhere.result()
            if not isinstance(answer, A4Error):
                return self._saved(answer, 0.0)
            if answer.fatal:
                return fresh(answer)

    def _first(self, key: str, mine: Future[Answer | A4Error], request: Request, cache: Cache) -> Answer | A4Error:
        """Look the answer up or ask for it, and tell those that wait for the same."""
        answer: Answer | A4Error = ProviderError("interrupted")
        try:
            started = time.perf_counter()
            kept = cache.get(key)
            if kept is not None:
                answer = self._saved(kept, time.perf_counter() - started)
                return answer
            answer = self._asked(request)
            if not isinstance(answer, A4Error) and self._session.settings.cache == "write":
                cache.put(key, answer)
            return answer
        except A4Error as error:
            answer = error
            raise
        finally:
            with self._lock:
                del self._asking[key]
            mine.set_result(answer)

    def _saved(self, answer: Answer, seconds: float) -> Answer:
        answer = with_usage(cast(Any, answer), cached=True, seconds=seconds, attempts=1)
        self.stats.count_answer(answer.usage)
        return answer

    def _asked(self, request: Request) -> Answer | A4Error:
        """Ask until there is an answer, a reason that will not go away, or no try or time left."""
        session, sample = self._session, self._session.sample
        session.missed(request)
        if isinstance(request, SegmentRequest):
            self.dispatcher.forget(request.image)
        tries, failures, seconds = 0, 0, 0.0
        while True:
            job = Job(request, sample.seconds_left)
            self.dispatcher.submit(job)
            outcome = job.wait()
            tries, seconds = tries + 1, seconds + job.seconds
            if sample.seconds_left is not None:
                sample.seconds_left = max(sample.seconds_left - job.seconds, 0.0)
            if not isinstance(outcome, Exception):
                usage = outcome.usage
                answer = with_usage(cast(Any, outcome), seconds=seconds, attempts=usage.attempts + tries - 1)
                self.stats.count_answer(answer.usage)
                return answer
            failures += not self.dispatcher.breaker.is_open
            wait = backoff(max(failures, 1), session.settings.retry_wait, outcome)
            in_time = sample.seconds_left is None or wait < sample.seconds_left
            again = isinstance(outcome, A4Error) and outcome.retryable and failures <= session.settings.retries
            if not again or not in_time or session.closing.is_set():
                self.stats.count_failure(again=False)
                return _final(self.id, outcome, tries)
            self.stats.count_failure(again=True)
            session.closing.wait(wait)
            seconds += wait
            if sample.seconds_left is not None:
                sample.seconds_left -= wait


def _final(expert: str, error: Exception, tries: int) -> A4Error:
    """The error that ends a request, with its number of attempts for the trace."""
    if isinstance(error, A4Error):
        final = fresh(error)
    else:
        final = ProviderError(f"{expert} failed: {error!r}")
        final.__cause__ = error
    final.__dict__["attempts"] = tries
    return final


def _role(expert: Expert) -> str:
    return next((role for role, verb in VERBS.items() if hasattr(expert, verb)), "expert")


def _enough_in_flight(agent: Agent) -> int:
    """Samples that keep the slowest expert busy.

    No expert but the slowest is busy all the time, so on average no more than the sum of what the experts can
    hold are being served (Little's law). The rest waits in front of the slowest, to bridge the ups and downs.
    """
    capacities = [max(1, expert.max_batch) * max(1, expert.concurrency) for expert in agent.experts()]
    return min(sum(capacities) + max(capacities) + 2, MOST_IN_FLIGHT)
