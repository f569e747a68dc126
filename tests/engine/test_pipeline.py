"""Every query has one answer, in order if asked; nothing is read ahead of need; stops are clean."""

from __future__ import annotations

import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import pytest

from a4agent import engine
from a4agent.agent import A4Agent
from a4agent.engine import EngineSettings, Stats
from a4agent.engine.pipeline import ordered_map
from a4agent.errors import BudgetExceeded, CredentialError, ProviderUnavailable, RequestRejected, UnreadableAnswer
from a4agent.protocols import ChatAnswer, ChatRequest, DetectRequest
from a4agent.stages.signals import Evidence
from a4agent.stages.spotter import Spotter
from a4agent.stages.thinker import Thinker
from a4agent.stages.verifier import Verifier
from a4agent.testing import ScriptedDetector, ScriptedEditor, ScriptedSegmenter, ScriptedVLM, output, scripted_agent
from a4agent.types import Affordance, Check, Detection, Given, Query, Target, Usage

Queries = Callable[[int], Iterator[Query]]


def until_stopped(answers: Iterator[tuple[Query, Affordance]]) -> tuple[list[Affordance], BaseException | None]:
    done: list[Affordance] = []
    try:
        for _, affordance in answers:
            done.append(affordance)
    except Exception as error:
        return done, error
    return done, None


def test_every_query_is_answered_once_with_its_own_answer(queries: Queries) -> None:
    def named(request: ChatRequest) -> str:
        number = int(np.asarray(request.images[0])[0, 0, 0])
        return output(f"part {number}")

    agent = A4Agent(None, Thinker(ScriptedVLM(named, concurrency=4)), Spotter(ScriptedDetector(), ScriptedSegmenter()))
    answers = list(engine.run(agent, queries(100)))
    assert Counter(query.id for query, _ in answers) == Counter(f"q{n}" for n in range(100))
    for query, affordance in answers:
        assert affordance.id == query.id
        assert affordance.target is not None
        assert affordance.target.object_part == f"part {query.id[1:]}"
        assert affordance.status == "ok"


def test_ordered_answers_come_in_the_order_of_the_queries(queries: Queries) -> None:
    lock, turn = threading.Lock(), [0]

    def uneven(request: ChatRequest) -> str:
        with lock:
            turn[0] += 1
            late = turn[0] % 5 == 1
        time.sleep(0.02 if late else 0)
        return output("the handle")

    agent = A4Agent(None, Thinker(ScriptedVLM(uneven, concurrency=8)), Spotter(ScriptedDetector(), ScriptedSegmenter()))
    assert [q.id for q, _ in engine.run(agent, queries(60), ordered=True)] == [f"q{n}" for n in range(60)]
    assert [q.id for q, _ in engine.run(agent, queries(60))] != [f"q{n}" for n in range(60)]


def test_stages_of_different_samples_overlap(queries: Queries) -> None:
    """The editor of one sample returns only when the detector of another is being asked at the same time."""
    both = threading.Barrier(2, timeout=20)
    first = iter([False] + [True] * 10)

    def edit(request: Any) -> Any:
        if next(first):
            both.wait()
        return request.image

    def detect(request: DetectRequest) -> list[Any]:
        both.wait()
        return [[0, 0, 4, 4]]

    agent = scripted_agent(dream=True)
    assert agent.dreamer is not None
    dreamer = type(agent.dreamer)(agent.dreamer.vlm, ScriptedEditor(edit))
    agent = A4Agent(dreamer, agent.thinker, Spotter(ScriptedDetector(detect), ScriptedSegmenter()))
    answers = []
    for answer in engine.run(agent, queries(4)):
        answers.append(answer)
        if len(answers) == 3:  # the last detection has no edit beside it
            threading.Thread(target=both.wait, daemon=True).start()
    assert [a.status for _, a in answers] == ["ok"] * 4


class Counted:
    """Queries, and how many of them were taken."""

    def __init__(self, queries: Iterable[Query]) -> None:
        self.taken = 0
        self._queries = queries

    def __iter__(self) -> Iterator[Query]:
        for query in self._queries:
            self.taken += 1
            yield query


def test_queries_are_taken_as_they_are_needed(queries: Queries) -> None:
    source = Counted(queries(10_000))

    settings = EngineSettings(in_flight=3)
    running = engine.run(scripted_agent(), source, settings=settings)
    for _ in range(10):
        next(running)
    time.sleep(0.1)
    assert source.taken <= 10 + 2 * 3 + 3
    running.close()
    before = source.taken
    time.sleep(0.05)
    assert source.taken <= before + 3


def test_in_order_no_more_is_read_ahead_of_a_slow_one(queries: Queries) -> None:
    source = Counted(queries(10_000))

    def first_is_slow(request: DetectRequest) -> list[Any]:
        time.sleep(0.3 if int(np.asarray(request.image)[0, 0].sum()) == 0 else 0)
        return [[0, 0, 4, 4]]

    agent = A4Agent(None, None, Spotter(ScriptedDetector(first_is_slow, concurrency=3), ScriptedSegmenter()))
    running = engine.run(agent, source, ordered=True, settings=EngineSettings(in_flight=3))
    query, _ = next(running)
    assert query.id == "q0"
    assert source.taken <= 2 * 3
    running.close()


def test_who_stops_early_leaves_no_thread_waiting(queries: Queries) -> None:
    """Samples in flight come to their next question, or back from a pause between tries, when the run is over."""

    def moody(request: DetectRequest) -> Any:
        return [[0, 0, 4, 4]] if int(np.asarray(request.image)[0, 0].sum()) == 0 else ProviderUnavailable("503")

    slow = ScriptedVLM(lambda request: output("the handle"), seconds=0.05, concurrency=8)
    agent = A4Agent(None, Thinker(slow), Spotter(ScriptedDetector(moody, concurrency=8), ScriptedSegmenter()))
    before = set(threading.enumerate())
    for _ in engine.run(agent, queries(100), settings=EngineSettings(retry_wait=5.0)):
        break
    deadline = time.monotonic() + 3.0
    while (left := set(threading.enumerate()) - before) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not left


@pytest.mark.parametrize("ordered", [False, True])
def test_samples_that_cannot_be_used_are_answers_too(ordered: bool, tmp_path: Any) -> None:
    queries = [
        Query("gone", tmp_path / "gone.png", "open"),
        Query("blank", np.zeros((4, 4, 3), np.uint8), "  "),
        Query("not text", np.zeros((4, 4, 3), np.uint8), None),  # type: ignore[arg-type]
        Query("garbage", b"not an image", "open"),
        Query("good", np.zeros((8, 8, 3), np.uint8), "open"),
    ]
    stats = Stats()
    answers = {q.id: a for q, a in engine.run(scripted_agent(), queries, ordered=ordered, stats=stats)}
    assert len(answers) == 5
    assert answers["good"].status == "ok"
    for name in ("gone", "blank", "not text", "garbage"):
        assert answers[name].status == "error"
        assert answers[name].id == name
        assert (answers[name].error or "").startswith("InputError: ")
        assert answers[name].mask.shape == (0, 0)
    assert stats.samples == {"error": 4, "ok": 1}


def test_one_failing_request_fails_its_sample_alone(queries: Queries) -> None:
    def picky(request: DetectRequest) -> Any:
        number = int(np.asarray(request.image)[0, 0, 0])
        if number == 3:
            return RequestRejected("no such picture, please")
        if number == 5:
            raise ZeroDivisionError("a bug in an expert")
        return [[0, 0, 4, 4]]

    agent = A4Agent(None, None, Spotter(ScriptedDetector(picky, max_batch=4), ScriptedSegmenter()))
    answers = {q.id: a for q, a in engine.run(agent, queries(20))}
    assert sorted(name for name, a in answers.items() if a.status != "ok") == ["q3", "q5"]
    assert "no such picture, please" in (answers["q3"].error or "")
    assert "a bug in an expert" in (answers["q5"].error or "")
    assert answers["q5"].trace.steps[-1].error
    assert sum(a.status == "ok" for a in answers.values()) == 18


def test_a_refused_key_stops_the_run_after_what_is_done(queries: Queries) -> None:
    lock = threading.Lock()
    calls = [0]

    def expiring(request: DetectRequest) -> Any:
        with lock:
            calls[0] += 1
            return [[0, 0, 4, 4]] if calls[0] <= 20 else CredentialError("the key has expired")

    agent = A4Agent(None, None, Spotter(ScriptedDetector(expiring, concurrency=4), ScriptedSegmenter()))
    done, stopped = until_stopped(engine.run(agent, queries(1000)))
    assert isinstance(stopped, CredentialError)
    assert re.search("expired", str(stopped))
    assert [a.status for a in done] == ["ok"] * 20
    assert calls[0] <= 20 + 4


def test_an_error_of_the_queries_is_raised_when_the_rest_is_done(queries: Queries) -> None:
    def broken() -> Iterator[Query]:
        yield from queries(7)
        raise RuntimeError("the dataset broke")

    done, stopped = until_stopped(engine.run(scripted_agent(), broken()))
    assert isinstance(stopped, RuntimeError)
    assert re.search("the dataset broke", str(stopped))
    assert len(done) == 7


def test_nothing_to_do() -> None:
    assert list(engine.run(scripted_agent(), [])) == []


def test_what_is_given_is_not_asked_for(queries: Queries) -> None:
    agent = scripted_agent()
    assert agent.thinker is not None
    given = Given(target=Target("t", "o", "the given part"))
    answers = list(engine.run(agent, queries(5), given=lambda query: given))
    assert {a.target.object_part for _, a in answers if a.target} == {"the given part"}
    assert agent.thinker.vlm.requests == []  # type: ignore[attr-defined]


def test_a_budget_of_money_is_kept_and_the_samples_in_flight_end(queries: Queries) -> None:
    def priced(request: ChatRequest) -> ChatAnswer:
        return ChatAnswer(output("the handle"), usage=Usage(cost=0.01))

    vlm = ScriptedVLM(priced, concurrency=8)
    agent = A4Agent(None, Thinker(vlm), Spotter(ScriptedDetector(), ScriptedSegmenter()))
    done, stopped = until_stopped(engine.run(agent, queries(1000), settings=EngineSettings(max_cost=0.305)))
    assert isinstance(stopped, BudgetExceeded)
    assert re.search(r"max_cost = 0.305", str(stopped))
    assert len(done) == len(vlm.requests) == 30
    assert {a.status for a in done} == {"ok"}


@pytest.mark.parametrize("verdict", ["no", "garbage"])
def test_a_verifier_that_never_accepts_stays_within_the_budget(queries: Queries, verdict: str) -> None:
    """Samples that are asked again cost three times as much as those that are not."""

    class Never:
        name, needs = "never", ("vlm",)

        def measure(self, evidence: Evidence) -> list[Check]:
            assert evidence.vlm is not None
            evidence.recorder.ask("verifier", evidence.vlm, ChatRequest((evidence.image,), "Is it right?"))
            if verdict == "garbage":
                raise UnreadableAnswer("the review is not the JSON that was asked for")
            return [Check("never", 0.1, "no", "thinker")]

    def priced(request: ChatRequest) -> ChatAnswer:
        return ChatAnswer(output("the handle"), usage=Usage(cost=0.01))

    vlm = ScriptedVLM(priced, concurrency=8)
    spotter = Spotter(ScriptedDetector(), ScriptedSegmenter())
    agent = A4Agent(None, Thinker(vlm), spotter, verifier=Verifier((Never(),), vlm=vlm))
    done, stopped = until_stopped(engine.run(agent, queries(1000), settings=EngineSettings(max_cost=0.505)))
    assert isinstance(stopped, BudgetExceeded)
    assert sum(a.trace.cost for a in done) <= 0.505
    assert len(vlm.requests) <= 50
    assert {a.status for a in done} == {"abstained"}
    assert len(vlm.requests) >= 40


def test_a_budget_that_the_last_sample_uses_up_stops_nothing(queries: Queries) -> None:
    vlm = ScriptedVLM(lambda request: ChatAnswer(output("the handle"), usage=Usage(cost=0.5)), concurrency=8)
    agent = A4Agent(None, Thinker(vlm), Spotter(ScriptedDetector(), ScriptedSegmenter()))
    done, stopped = until_stopped(engine.run(agent, queries(8), settings=EngineSettings(max_cost=4.0)))
    assert stopped is None
    assert len(done) == 8


def test_a_budget_of_time_is_kept(queries: Queries) -> None:
    agent = A4Agent(None, None, Spotter(ScriptedDetector(seconds=0.02), ScriptedSegmenter()))
    done, stopped = until_stopped(engine.run(agent, queries(1000), settings=EngineSettings(max_seconds=0.5)))
    assert isinstance(stopped, BudgetExceeded)
    assert re.search(r"max_seconds = 0.5", str(stopped))
    assert 1 <= len(done) <= 30
    assert {a.status for a in done} == {"ok"}


def test_a_call_that_hangs_fails_its_sample_and_not_the_run(queries: Queries) -> None:
    release = threading.Event()

    def hanging(request: DetectRequest) -> Any:
        if int(np.asarray(request.image)[0, 0, 0]) in (2, 9):
            release.wait(30)
        return [[0, 0, 4, 4]]

    detector = ScriptedDetector(hanging)
    agent = A4Agent(None, None, Spotter(detector, ScriptedSegmenter()))
    settings = EngineSettings(max_sample_seconds=0.4)
    answers = {q.id: a for q, a in engine.run(agent, queries(20), settings=settings)}
    release.set()
    assert sorted(name for name, a in answers.items() if a.status == "error") == ["q2", "q9"]
    assert "max_sample_seconds" in (answers["q2"].error or "")
    assert sum(a.status == "ok" for a in answers.values()) == 18


def test_waiting_for_a_turn_is_not_held_against_a_sample(queries: Queries) -> None:
    agent = A4Agent(None, None, Spotter(ScriptedDetector(seconds=0.03), ScriptedSegmenter()))
    settings = EngineSettings(max_sample_seconds=0.6, in_flight=30)
    answers = list(engine.run(agent, queries(30), settings=settings))  # the last one waits for 0.9 s
    assert {a.status for _, a in answers} == {"ok"}


def test_predict_many_takes_pairs_and_settings() -> None:
    pairs = [(np.full((8, 8, 3), n, np.uint8), f"use {n}") for n in range(9)]
    answers = list(scripted_agent().predict_many(pairs, ordered=True, in_flight=2))
    assert [a.id for a in answers] == [str(n) for n in range(9)]
    assert [a.instruction for a in answers] == [f"use {n}" for n in range(9)]


def test_batches_form_while_the_expert_is_busy(queries: Queries) -> None:
    detector = ScriptedDetector(seconds=0.01, max_batch=8)
    agent = A4Agent(None, None, Spotter(detector, ScriptedSegmenter()))
    answers = list(engine.run(agent, queries(64)))
    assert len(answers) == len(detector.requests) == 64
    assert max(detector.batches) == 8
    assert len(detector.batches) <= 20


def test_no_expert_is_asked_for_more_than_it_can_take(queries: Queries) -> None:
    lock, now, most = threading.Lock(), [0], [0]

    def watched(request: DetectRequest) -> Detection:
        with lock:
            now[0] += 1
            most[0] = max(most[0], now[0])
        time.sleep(0.002)
        with lock:
            now[0] -= 1
        return Detection(np.array([[0, 0, 4, 4]], np.float32))

    agent = A4Agent(None, None, Spotter(ScriptedDetector(watched, concurrency=3), ScriptedSegmenter()))
    list(engine.run(agent, queries(100), settings=EngineSettings(in_flight=32)))
    assert most[0] == 3


def test_results_come_in_order_however_long_each_takes() -> None:
    def slow_first(number: int) -> int:
        time.sleep(0.02 if number % 4 == 0 else 0)
        return number * 2

    assert list(ordered_map(slow_first, range(40), workers=4)) == [2 * number for number in range(40)]


def test_no_more_is_taken_than_is_being_worked_on() -> None:
    taken = 0

    def items() -> Iterator[int]:
        nonlocal taken
        for number in range(1000):
            taken += 1
            yield number

    results = ordered_map(lambda number: number, items(), workers=3)

    assert next(results) == 0
    assert taken == 6
    results.close()
    assert taken == 6


def test_threads_are_used_and_end() -> None:
    barrier = threading.Barrier(3, timeout=5)

    assert len(list(ordered_map(lambda _: barrier.wait(), range(3), workers=3))) == 3
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("a4-map")]


def test_an_error_comes_at_its_turn() -> None:
    results = ordered_map(lambda number: 6 // (3 - number), range(10), workers=2)

    assert [next(results) for _ in range(3)] == [2, 3, 6]
    with pytest.raises(ZeroDivisionError):
        next(results)
    assert list(ordered_map(str, [], workers=2)) == []
