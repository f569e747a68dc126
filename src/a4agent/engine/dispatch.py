"""One expert's queue: requests of all samples come in one by one, and go to the expert in batches.

A sample asks one thing at a time, so a queue never holds more requests than there are samples in flight.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from typing import cast

from PIL.Image import Image

from a4agent.engine.retry import Breaker, Pace, fresh
from a4agent.engine.stats import ExpertStats
from a4agent.errors import A4Error, ProviderError, ProviderTimeout, RateLimited
from a4agent.protocols import Answer, Expert, Prepares, Request, ask

Outcome = Answer | Exception

PREPARED_AHEAD = 4
"""How many images a segmenter may have encoded and not yet segmented; it keeps only so many encodings."""


class RunStopped(ProviderError):
    """The run was stopped before this request was sent."""

    def __init__(self, message: str = "the run was stopped before this request was sent") -> None:
        super().__init__(message)


class QueuedRequest:
    """A request, the model time that its sample has left in seconds, and the place of its outcome."""

    def __init__(self, request: Request, seconds_left: float | None = None) -> None:
        self.request = request
        self.seconds_left = seconds_left
        self.seconds = 0.0
        self._outcome: Future[Outcome] = Future()

    @property
    def settled(self) -> bool:
        return self._outcome.done()

    def settle(self, outcome: Outcome, seconds: float) -> None:
        """Set the outcome, after `seconds` of model time. The first one counts."""
        with suppress(InvalidStateError):
            if not self.settled:
                self.seconds = seconds
            self._outcome.set_result(outcome)

    def wait(self) -> Outcome:
        return self._outcome.result()


class _Call:
    """One call of the expert: jobs to answer, or else images to prepare. `started` is 0 until it is made."""

    def __init__(self, jobs: list[QueuedRequest], images: list[Image]) -> None:
        self.jobs = jobs
        self.images = images
        self.started = 0.0
        self.replaced = False


class Dispatcher:
    """Keeps up to `expert.concurrency` calls of up to `expert.max_batch` requests in flight, a thread for each.

    There are fewer while a provider asks to slow down. A call that is not full waits `batch_wait` seconds for more
    requests. A batch that fails for another reason than an unreachable expert is asked again one by one, so that a
    bad request fails alone. Experts that can run out of memory shrink their batches themselves.
    """

    def __init__(self, expert: Expert, breaker: Breaker, stats: ExpertStats, batch_wait: float) -> None:
        self.expert = expert
        self.breaker = breaker
        self.stats = stats
        self._batch_wait = batch_wait
        self._max_batch = max(1, expert.max_batch)
        self._slots = max(1, expert.concurrency)
        self._pace = Pace(self._slots)
        self._jobs: deque[QueuedRequest] = deque()
        self._to_prepare: dict[int, Image] = {}
        self._prepared: set[int] = set()
        self._calls: set[_Call] = set()
        self._changed = threading.Condition()
        self._threads = 0
        self._idle = 0
        self._filling = False
        self._closed = False

    def submit(self, job: QueuedRequest) -> None:
        """Queue a request; it fails at once if the run is over."""
        with self._changed:
            if self._closed:
                job.settle(RunStopped(), 0.0)
                return
            self._jobs.append(job)
            self._wake()

    def prepare(self, image: Image) -> None:
        """Let the segmenter encode `image` when it is idle."""
        if isinstance(self.expert, Prepares):
            with self._changed:
                self._to_prepare[id(image)] = image
                self._wake()

    def forget(self, image: Image) -> None:
        """Forget to prepare `image`: it is being segmented, or its sample is over."""
        with self._changed:
            self._to_prepare.pop(id(image), None)
            self._prepared.discard(id(image))
            if self._to_prepare:
                self._wake()

    def close(self) -> None:
        """Let idle threads end; requests still queued, or held back by the breaker, fail."""
        self.breaker.give_up(RunStopped())
        with self._changed:
            self._closed = True
            for job in self._jobs:
                job.settle(RunStopped(), 0.0)
            self._jobs.clear()
            self._to_prepare.clear()
            self._changed.notify_all()

    def abandon_overdue(self, limit: float) -> None:
        """Fail the requests that have taken longer than their samples have left; `limit` is a sample's whole time.

        The thread of a call that has not returned after twice the limit counts as lost and is replaced, so a
        call that is merely slow never runs beside the next one.
        """
        now = time.monotonic()
        with self._changed:
            for call in [call for call in self._calls if call.started]:
                seconds = now - call.started
                for job in call.jobs:
                    if not job.settled and job.seconds_left is not None and seconds > job.seconds_left:
                        error = ProviderTimeout(
                            f"{self.expert.id} gave no answer within the {limit:g} s of model time that a sample may"
                            " take; raise engine.max_sample_seconds"
                        )
                        job.settle(error, seconds)
                        self.breaker.failed(error)
                if seconds > 2 * limit:
                    call.replaced = True
                    self._calls.discard(call)
                    self._threads -= 1
                    self._wake()

    def _wake(self) -> None:
        """Put a thread to work, if there is work and a slot."""
        if self._closed or not self._has_work():
            return
        if self._idle:
            self._changed.notify_all() if self._filling else self._changed.notify()
        elif self._threads < self._slots:
            self._threads += 1
            threading.Thread(target=self._work, name=f"a4 {self.expert.id}", daemon=True).start()

    def _has_work(self) -> bool:
        if len(self._calls) >= self._pace.calls:
            return False
        return bool(self._jobs or (self._to_prepare and len(self._prepared) < PREPARED_AHEAD))

    def _work(self) -> None:
        while (call := self._take()) is not None:
            self._serve(call)
            with self._changed:
                if call.replaced:
                    return
                self._calls.discard(call)
            del call

    def _take(self) -> _Call | None:
        """The next call to make; None when the run is over."""
        with self._changed:
            self._idle += 1
            while not self._closed and (self._filling or not self._has_work()):
                self._changed.wait()
            if not self._closed and 0 < len(self._jobs) < self._max_batch and self._batch_wait:
                self._filling = True
                self._changed.wait_for(lambda: self._closed or len(self._jobs) >= self._max_batch, self._batch_wait)
                self._filling = False
            self._idle -= 1
            if self._closed:
                self._threads -= 1
                return None
            call = _Call(self._next_jobs(), []) if self._jobs else _Call([], self._next_images())
            self._calls.add(call)
            self._wake()
            return call

    def _next_jobs(self) -> list[QueuedRequest]:
        jobs = [self._jobs.popleft()]
        while self._jobs and len(jobs) < self._max_batch and self._jobs[0].request.verb == jobs[0].request.verb:
            jobs.append(self._jobs.popleft())
        return jobs

    def _next_images(self) -> list[Image]:
        room = min(self._max_batch, PREPARED_AHEAD - len(self._prepared))
        chosen = list(self._to_prepare)[:room]
        self._prepared.update(chosen)
        return [self._to_prepare.pop(name) for name in chosen]

    def _serve(self, call: _Call) -> None:
        if not call.jobs:
            call.started = time.monotonic()
            with suppress(BaseException):  # the segmentation will meet the same error and report it
                cast(Prepares, self.expert).prepare(call.images)
            return
        try:
            self.breaker.enter()
        except A4Error as error:
            for job in call.jobs:
                job.settle(fresh(error), 0.0)
            return
        call.started = time.monotonic()
        outcomes = self._ask([job.request for job in call.jobs])
        seconds = time.monotonic() - call.started
        self.stats.count_call(len(call.jobs), seconds)
        self._judge(outcomes, call.started)
        for job, outcome in zip(call.jobs, outcomes, strict=True):
            job.settle(outcome, seconds)

    def _ask(self, requests: Sequence[Request]) -> list[Outcome]:
        try:
            answers = ask(self.expert, requests)
            if len(answers) != len(requests):
                raise ProviderError(f"{self.expert.id} returned {len(answers)} answers to {len(requests)} requests")
            return list(answers)
        except BaseException as raised:
            # Anything but an Exception (a panic in Rust code, sys.exit) would end the thread, and its samples hang.
            error = raised if isinstance(raised, Exception) else ProviderError(f"{self.expert.id} failed: {raised!r}")
            if len(requests) == 1:
                return [error]
            if isinstance(error, A4Error) and (error.fatal or error.retryable):
                return [fresh(error) for _ in requests]
            return [outcome for request in requests for outcome in self._ask([request])]

    def _judge(self, outcomes: Sequence[Outcome], started: float) -> None:
        """Tell the breaker and the pace how the call went. One answer in a batch shows that the expert is up."""
        with self._changed:
            if any(isinstance(outcome, RateLimited) for outcome in outcomes):
                self._pace.limited(started)
            else:
                self._pace.succeeded()
        failures = [outcome for outcome in outcomes if isinstance(outcome, Exception)]
        for error in failures:
            if isinstance(error, A4Error) and error.fatal:
                return self.breaker.give_up(error)
        down = [error for error in failures if isinstance(error, ProviderError) or not isinstance(error, A4Error)]
        if len(down) < len(outcomes):
            return self.breaker.succeeded()
        error = down[0]
        self.breaker.failed(error if isinstance(error, ProviderError) else ProviderError(repr(error)))
        return None
