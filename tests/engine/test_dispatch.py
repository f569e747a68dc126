"""Batches fill, shrink when memory runs out, and do not spoil each other; images are prepared in idle time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import pytest
from PIL import Image

from a4agent.engine.dispatch import PREPARED_AHEAD, Dispatcher, QueuedRequest
from a4agent.engine.retry import Breaker
from a4agent.engine.stats import ExpertStats
from a4agent.errors import (
    A4Error,
    CredentialError,
    OutOfMemory,
    ProviderError,
    ProviderTimeout,
    ProviderUnavailable,
    RequestRejected,
)
from a4agent.protocols import Answer, DetectRequest, Expert, ExpertBase, Segmentation, SegmentRequest
from a4agent.testing import ScriptedDetector

PHOTO = Image.new("RGB", (8, 6))
Make = Callable[..., Dispatcher]


@pytest.fixture
def make() -> Iterator[Make]:
    made: list[Dispatcher] = []

    def build(expert: Expert, batch_wait: float = 0.05) -> Dispatcher:
        made.append(Dispatcher(expert, Breaker("x", 0.01, 5.0), ExpertStats("detector", "x"), batch_wait))
        return made[-1]

    yield build
    for dispatcher in made:
        dispatcher.close()


def ask(dispatcher: Dispatcher, *phrases: str) -> list[Answer | Exception]:
    jobs = [QueuedRequest(DetectRequest(PHOTO, phrase)) for phrase in phrases]
    for job in jobs:
        dispatcher.submit(job)
    return [job.wait() for job in jobs]


def test_requests_that_come_together_go_together(make: Make) -> None:
    detector = ScriptedDetector(max_batch=4)
    ask(make(detector), *"abcdefghij")
    assert detector.batches == [4, 4, 2]
    assert [request.phrase for request in detector.requests] == list("abcdefghij")


def test_a_full_batch_does_not_wait(make: Make) -> None:
    started = time.monotonic()
    ask(make(ScriptedDetector(max_batch=4), batch_wait=20.0), *"abcd")
    assert time.monotonic() - started < 10.0


def test_a_batch_that_is_not_full_waits_only_so_long(make: Make) -> None:
    detector = ScriptedDetector(max_batch=4)
    started = time.monotonic()
    ask(make(detector, batch_wait=0.1), "a")
    assert 0.09 < time.monotonic() - started < 5.0


def test_a_batch_without_room_in_memory_is_asked_one_by_one(make: Make) -> None:
    """Experts that can run out of memory shrink their batches themselves; one that raises is not lost."""

    class Greedy(ScriptedDetector):
        def detect(self, requests: Sequence[DetectRequest]) -> Any:
            if len(requests) > 1:
                raise OutOfMemory(f"{len(requests)} do not fit")
            return [OutOfMemory("none fits")] if requests[0].phrase == "b" else super().detect(requests)

    answers = ask(make(Greedy(max_batch=4)), *"abcd")
    assert [isinstance(answer, OutOfMemory) for answer in answers] == [False, True, False, False]


def test_the_request_that_fills_a_batch_wakes_the_thread_that_waits_for_it(make: Make) -> None:
    """Not the one that has been idle for longer, which would leave the batch to its time limit."""
    dispatcher = make(ScriptedDetector(max_batch=2, concurrency=2, seconds=0.05), batch_wait=20.0)
    ask(dispatcher, *"abcd")
    until(lambda: dispatcher._idle == 2)
    first, second = QueuedRequest(DetectRequest(PHOTO, "e")), QueuedRequest(DetectRequest(PHOTO, "f"))
    dispatcher.submit(first)
    until(lambda: dispatcher._filling)
    started = time.monotonic()
    dispatcher.submit(second)
    assert not isinstance(first.wait(), Exception)
    assert time.monotonic() - started < 10.0


def test_a_request_that_breaks_its_batch_fails_alone(make: Make) -> None:
    def answer(request: DetectRequest) -> Any:
        if request.phrase == "c":
            raise ZeroDivisionError("a bug")
        return RequestRejected("no") if request.phrase == "d" else [[0, 0, 4, 4]]

    answers = ask(make(ScriptedDetector(answer, max_batch=8)), *"abcde")
    assert [type(a).__name__ for a in answers] == [
        "Detection",
        "Detection",
        "ZeroDivisionError",
        "RequestRejected",
        "Detection",
    ]


class Panic(BaseException):
    """What Rust code raises in Python."""


def test_a_base_exception_fails_one_request_and_the_rest_are_answered(make: Make) -> None:
    def answer(request: DetectRequest) -> Any:
        if request.phrase == "c":
            raise Panic("index out of bounds")
        return [[0, 0, 4, 4]]

    for most in (1, 4):
        answers = ask(make(ScriptedDetector(answer, id="rusty:detector", max_batch=most)), *"abcde")
        assert [isinstance(a, ProviderError) for a in answers] == [False, False, True, False, False]
        assert "rusty:detector failed: Panic('index out of bounds')" in str(answers[2])


def test_an_expert_that_is_down_is_not_asked_again_for_each_of_the_batch(make: Make) -> None:
    class Down(ScriptedDetector):
        calls = 0

        def detect(self, requests: Sequence[DetectRequest]) -> Any:
            self.calls += 1
            raise ProviderUnavailable("down")

    detector = Down(max_batch=8)
    answers = ask(make(detector), *"abcdefgh")
    assert all(isinstance(answer, ProviderUnavailable) for answer in answers)
    assert len({id(answer) for answer in answers}) == 8  # each to be raised in a thread of its own
    assert detector.calls == 1


def test_an_expert_that_miscounts_is_an_error(make: Make) -> None:
    class Short(ScriptedDetector):
        def detect(self, requests: Sequence[DetectRequest]) -> Any:
            return super().detect(requests)[:-1]

    (answer,) = ask(make(Short()), "a")
    assert isinstance(answer, ProviderError)
    assert "0 answers to 1 request" in str(answer)


class SlowSegmenter(ExpertBase):
    """Tells in which order it prepared (image numbers) and segmented ("s")."""

    def __init__(self) -> None:
        super().__init__("slow:segmenter")
        self.done: list[Any] = []
        self.gate = threading.Event()

    def prepare(self, images: Sequence[Image.Image]) -> None:
        self.done += [image.size[0] for image in images]

    def segment(self, requests: Sequence[SegmentRequest]) -> list[Segmentation | A4Error]:
        self.gate.wait(10)
        self.done += ["s"] * len(requests)
        return [RequestRejected("it only tells the order") for _ in requests]


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 5.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.002)


def test_preparing_waits_for_those_that_segment_and_keeps_within_bounds(make: Make) -> None:
    segmenter = SlowSegmenter()
    dispatcher = make(segmenter)
    jobs = [QueuedRequest(SegmentRequest(PHOTO, ())) for _ in range(3)]
    for job in jobs:
        dispatcher.submit(job)
    images = [Image.new("RGB", (number, 4)) for number in range(1, 11)]
    for image in images:
        dispatcher.prepare(image)
    segmenter.gate.set()
    until(lambda: len(segmenter.done) == 3 + PREPARED_AHEAD)
    time.sleep(0.02)
    assert segmenter.done == ["s", "s", "s", 1, 2, 3, 4]
    dispatcher.forget(images[6])  # its sample ended without a segmentation: never prepared
    dispatcher.forget(images[0])  # segmented: room for the next
    until(lambda: len(segmenter.done) == 3 + PREPARED_AHEAD + 1)
    assert segmenter.done[3:] == [1, 2, 3, 4, 5]
    for image in images[1:6]:
        dispatcher.forget(image)
    until(lambda: len(segmenter.done) == 3 + 8)
    assert segmenter.done[3:] == [1, 2, 3, 4, 5, 8, 9, 10]


def test_images_prepared_together_stay_within_the_same_bounds(make: Make) -> None:
    segmenter = SlowSegmenter()
    segmenter.max_batch = 3
    dispatcher = make(segmenter, batch_wait=0.0)
    dispatcher.submit(QueuedRequest(SegmentRequest(PHOTO, ())))
    for number in range(1, 11):
        dispatcher.prepare(Image.new("RGB", (number, 4)))
    segmenter.gate.set()
    until(lambda: len(segmenter.done) == 1 + PREPARED_AHEAD)
    time.sleep(0.02)
    assert segmenter.done == ["s", 1, 2, 3, 4]


def test_a_preparation_that_hangs_does_not_block_the_segmenter_for_good(make: Make) -> None:
    release = threading.Event()

    class Hanging(SlowSegmenter):
        def prepare(self, images: Sequence[Image.Image]) -> None:
            super().prepare(images)
            release.wait(10)

    segmenter = Hanging()
    segmenter.gate.set()
    dispatcher = make(segmenter)
    dispatcher.prepare(PHOTO)
    until(lambda: segmenter.done == [8])
    job = QueuedRequest(SegmentRequest(PHOTO, ()), 0.1)
    dispatcher.submit(job)
    time.sleep(0.25)
    dispatcher.abandon_overdue(0.1)
    until(lambda: job.settled)
    assert segmenter.done == [8, "s"]
    release.set()


@pytest.mark.parametrize("error", [ValueError("no picture"), Panic("index out of bounds")])
def test_a_preparation_that_fails_leaves_the_segmentation_as_it_is(make: Make, error: BaseException) -> None:
    class Failing(SlowSegmenter):
        def prepare(self, images: Sequence[Image.Image]) -> None:
            super().prepare(images)
            raise error

    segmenter = Failing()
    segmenter.gate.set()
    dispatcher = make(segmenter)
    dispatcher.prepare(PHOTO)
    until(lambda: segmenter.done == [8])
    job = QueuedRequest(SegmentRequest(PHOTO, ()))
    dispatcher.submit(job)
    until(lambda: job.settled)


def test_an_overdue_call_is_given_up_and_its_slot_used_again_only_later(make: Make) -> None:
    release = threading.Event()

    def answer(request: DetectRequest) -> Any:
        if request.phrase == "hang":
            release.wait(10)
        return [[0, 0, 4, 4]]

    detector = ScriptedDetector(answer)
    dispatcher = make(detector)
    hanging, next_one = (
        QueuedRequest(DetectRequest(PHOTO, "hang"), 0.3),
        QueuedRequest(DetectRequest(PHOTO, "fine"), 0.3),
    )
    dispatcher.submit(hanging)
    dispatcher.submit(next_one)
    time.sleep(0.35)
    dispatcher.abandon_overdue(0.3)
    outcome = hanging.wait()
    assert isinstance(outcome, ProviderTimeout)
    assert hanging.seconds >= 0.3
    assert not next_one.settled  # the call may only be slow: nothing runs beside it yet
    time.sleep(0.3)
    dispatcher.abandon_overdue(0.3)
    assert not isinstance(next_one.wait(), Exception)
    release.set()


def test_closing_fails_what_is_queued(make: Make) -> None:
    gate = threading.Event()

    def answer(request: DetectRequest) -> Any:
        gate.wait(10)
        return [[0, 0, 4, 4]]

    dispatcher = make(ScriptedDetector(answer))
    first, second = QueuedRequest(DetectRequest(PHOTO, "a")), QueuedRequest(DetectRequest(PHOTO, "b"))
    dispatcher.submit(first)
    dispatcher.submit(second)
    until(lambda: len(dispatcher.expert.requests) == 1)  # type: ignore[attr-defined]
    dispatcher.close()
    assert isinstance(second.wait(), ProviderError)
    gate.set()
    assert not isinstance(first.wait(), Exception)


def test_after_closing_new_and_held_requests_fail(make: Make) -> None:
    detector = ScriptedDetector(lambda request: ProviderUnavailable("down"))
    dispatcher = Dispatcher(detector, Breaker("x", 60.0, 600.0), ExpertStats("detector", "x"), 0.0)
    ask(dispatcher, *"abcdefghij")  # ten failures in a row: the breaker holds the next back for a minute
    held = QueuedRequest(DetectRequest(PHOTO, "k"))
    dispatcher.submit(held)
    until(lambda: not dispatcher._jobs)
    dispatcher.close()
    (late,) = ask(dispatcher, "l")
    for outcome in (held.wait(), late):
        assert isinstance(outcome, ProviderError)
        assert "stopped" in str(outcome)
    assert len(detector.requests) == 10


def test_closing_ends_every_idle_thread(make: Make) -> None:
    dispatcher = make(ScriptedDetector(id="closing:detector", concurrency=3, seconds=0.05))
    ask(dispatcher, *"abc")
    until(lambda: dispatcher._idle == 3)
    dispatcher.close()
    until(lambda: not any(thread.name == "a4 closing:detector" for thread in threading.enumerate()))


def test_nothing_is_sent_to_an_expert_that_was_given_up(make: Make) -> None:
    detector = ScriptedDetector()
    dispatcher = make(detector)
    dispatcher.breaker.give_up(CredentialError("refused"))
    (answer,) = ask(dispatcher, "a")
    assert isinstance(answer, CredentialError)
    assert not detector.requests
