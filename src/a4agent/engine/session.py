"""An agent prepared for many samples at once: its experts stand behind queues, a cache and breakers.

`EngineSession.predict` may be called from any number of threads; stage code stays plain and sequential. A request
takes this path: cache, an identical request in flight, the expert's queue, and again after a pause if that may help.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import replace
from typing import Any, cast

from a4agent.config import EngineSettings
from a4agent.engine.cache import Cache, default_folder, key_of
from a4agent.engine.dispatch import Dispatcher, QueuedRequest, RunStopped
from a4agent.engine.retry import Breaker, backoff, fresh
from a4agent.engine.stats import Stats
from a4agent.errors import A4Error, BudgetExceeded, ConfigError, ProviderError
from a4agent.protocols import (
    VERBS,
    Agent,
    Answer,
    Charges,
    ChatRequest,
    Expert,
    Repeats,
    Request,
    SegmentRequest,
    with_usage,
)
from a4agent.redaction import redact
from a4agent.types import Affordance, Given, Query, Trace

MOST_IN_FLIGHT = 128


class Unfinished(BaseException):
    """A stop ended a wait of this sample: it has no answer, and a later run asks for it again."""


class _Sample(threading.local):
    """The sample that a thread is working on."""

    seconds_left: float | None = None
    image: Any = None
    chats: tuple[str, ...] = ()


class EngineSession:
    """The experts of one run behind their queues. Close it when the run is over; the agent stays open.

    Raises:
        ConfigError: `settings.max_cost` is set, and an expert charges for its answers at an unknown price.
    """

    def __init__(self, agent: Agent, settings: EngineSettings, stats: Stats | None = None) -> None:
        if settings.max_cost is not None:
            _check_prices(agent)
        self.settings = settings
        self.stats = stats or Stats()
        self.uncounted: BudgetExceeded | None = None
        folder = settings.cache_dir or default_folder()
        self.cache = None if settings.cache == "off" else Cache(folder, settings.cache_gb * 1e9)
        self.sample = _Sample()
        self.closing = threading.Event()
        self.no_waiting = threading.Event()
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
        """The answer to a query. A failure of this sample alone is returned in its status and error.

        Raises:
            A4Error: every other sample would fail in the same way (`error.fatal`).
            Unfinished: the run was stopped while this sample waited.
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
        """Note that the cache lacks the answer to a request of this sample; the first starts the image encoding."""
        if self.sample.image is not None or self._segmenter is None:
            return
        images = request.images[:1] if isinstance(request, ChatRequest) else (request.image,)
        for image in images:
            self.sample.image = image
            if not isinstance(request, SegmentRequest):
                self._segmenter.dispatcher.prepare(image)

    def _forget_chats(self) -> None:
        """Remove the chat answers of an invalid sample from the cache: asking again may do better."""
        for key in self.sample.chats:
            if self.cache is not None:
                self.cache.remove(key)

    def end_waits(self) -> None:
        """Wait no more before retries and for experts that are down; the samples that would are `Unfinished`."""
        self.no_waiting.set()
        for queued in self._queued:
            queued.dispatcher.breaker.end_waits(RunStopped())

    def close(self) -> None:
        """End the idle threads; calls in flight end on their own."""
        self.closing.set()
        self.no_waiting.set()
        for queued in self._queued:
            queued.dispatcher.close()

    def _watch(self, limit: float) -> None:
        while not self.closing.wait(min(max(limit / 20, 0.01), 1.0)):
            for queued in self._queued:
                queued.dispatcher.abandon_overdue(limit)


class QueuedExpert:
    """Stands in for an expert and has the same methods: a stage cannot tell them apart."""

    def __init__(self, expert: Expert, session: EngineSession) -> None:
        settings = session.settings
        self.expert = expert
        self.id = expert.id
        self.max_batch = expert.max_batch
        self.concurrency = expert.concurrency
        self.stats = session.stats.of(_role(expert), expert.id)
        breaker = Breaker(expert.id, settings.retry_wait * 2, settings.outage_seconds)
        # The engine repeats calls itself: a stop can end its waits, and they hold up no other sample.
        once = expert.without_retries() if isinstance(expert, Repeats) else expert
        self.dispatcher = Dispatcher(once, breaker, self.stats, settings.batch_wait_ms / 1000)
        self._session = session
        for verb in VERBS.values():
            if hasattr(expert, verb):
                setattr(self, verb, self._answer_all)
        self._lock = threading.Lock()
        self._asking: dict[str, Future[Answer | A4Error]] = {}

    def fingerprint(self) -> Any:
        return self.expert.fingerprint()

    def close(self) -> None:
        return None

    def _answer_all(self, requests: Sequence[Request]) -> list[Answer | A4Error]:
        return [self._answer(request) for request in requests]

    def _answer(self, request: Request) -> Answer | A4Error:
        cache = self._session.cache
        if cache is None:
            return self._asked(request)
        key = key_of(self.expert, request)
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
        """Look the answer up or ask for it, and pass it to the threads that wait for the same one."""
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
        """Ask until there is an answer, an error that will not pass, or no try or time left."""
        session, settings, sample = self._session, self._session.settings, self._session.sample
        session.missed(request)
        if isinstance(request, SegmentRequest):
            self.dispatcher.forget(request.image)
        tries, failures, seconds = 0, 0, 0.0
        while True:
            queued = QueuedRequest(request, sample.seconds_left)
            self.dispatcher.submit(queued)
            outcome = queued.wait()
            if isinstance(outcome, RunStopped):
                raise Unfinished
            tries, seconds = tries + 1, seconds + queued.seconds
            if sample.seconds_left is not None:
                sample.seconds_left = max(sample.seconds_left - queued.seconds, 0.0)
            if not isinstance(outcome, Exception):
                usage = outcome.usage
                answer = with_usage(cast(Any, outcome), seconds=seconds, attempts=usage.attempts + tries - 1)
                self.stats.count_answer(answer.usage)
                self._check_counted(answer)
                return answer
            failures += not self.dispatcher.breaker.is_open
            wait = backoff(max(failures, 1), settings.retry_wait, outcome, settings.max_retry_after)
            in_time = sample.seconds_left is None or wait < sample.seconds_left
            again = isinstance(outcome, A4Error) and outcome.retryable and failures <= settings.retries
            if not again or not in_time:
                self.stats.count_failure(getattr(outcome, "usage", None))
                return _final(self.id, outcome, tries)
            self.stats.count_retry()
            if session.no_waiting.wait(wait):
                raise Unfinished
            seconds += wait
            if sample.seconds_left is not None:
                sample.seconds_left -= wait

    def _check_counted(self, answer: Answer) -> None:
        """Let the run end if it has a limit of cost and this expert charges an unknown amount."""
        if (
            self._session.settings.max_cost is not None
            and isinstance(self.expert, Charges)
            and answer.usage.cost is None
        ):
            self._session.uncounted = BudgetExceeded(
                f"cannot keep to engine.max_cost = {self._session.settings.max_cost:g}: {self.id} answered without"
                " its token usage, so the cost is unknown; run again without the limit to continue"
            )


def _check_prices(agent: Agent) -> None:
    for expert in agent.experts():
        if isinstance(expert, Charges) and not expert.price_known:
            raise ConfigError(
                f"cannot keep to engine.max_cost: the price of {expert.id} is unknown; set its `price`, such as"
                " {input = 2.5, output = 10.0} in dollars per million tokens (0.0 if it is free), or remove the limit"
            )


def _final(expert: str, error: Exception, tries: int) -> A4Error:
    """The error that ends a request, with the number of attempts for the trace."""
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

    Only the slowest expert is busy all the time, so on average the experts serve no more requests than the sum of
    what they can hold (Little's law). The rest waits in front of the slowest, to bridge fluctuations.
    """
    capacities = [max(1, expert.max_batch) * max(1, expert.concurrency) for expert in agent.experts()]
    return min(sum(capacities) + max(capacities) + 2, MOST_IN_FLIGHT)
