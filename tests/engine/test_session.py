"""Nothing is asked twice: not across runs, not at once, not when only a later stage changes."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from PIL import Image

from a4agent import engine
from a4agent.agent import A4Agent
from a4agent.engine import EngineSettings, Stats
from a4agent.engine.session import EngineSession, Unfinished
from a4agent.errors import (
    AnswerError,
    BudgetExceeded,
    ConfigError,
    OutOfMemory,
    ProviderTimeout,
    ProviderUnavailable,
    RateLimited,
    RefusedAnswer,
    RequestRejected,
)
from a4agent.experts.remote import chat
from a4agent.protocols import ChatAnswer, ChatRequest, DetectRequest, EditRequest
from a4agent.stages.dreamer import Dreamer
from a4agent.stages.spotter import Spotter
from a4agent.stages.thinker import Thinker
from a4agent.testing import ScriptedDetector, ScriptedEditor, ScriptedSegmenter, ScriptedVLM, output, scripted_agent
from a4agent.types import Affordance, Detection, Query, Usage
from servers import FaultyServer, error

Queries = Callable[[int], Iterator[Query]]


def make_agent(segmenter: str = "sam:large", thinker_vlm: str = "vlm:a") -> tuple[A4Agent, dict[str, Any]]:
    def think(request: ChatRequest) -> ChatAnswer:
        text = output("the handle") if "### Output" in request.text else f"Edit it. {request.text[-20:]}"
        return ChatAnswer(text, usage=Usage(cost=0.01, tokens_in=100, tokens_out=10))

    def redraw(request: EditRequest) -> Image.Image:
        return Image.eval(request.image, lambda value: 255 - value)

    experts: dict[str, Any] = {
        "dreamer": ScriptedVLM(think, id="vlm:dreamer", concurrency=4),
        "thinker": ScriptedVLM(think, id=thinker_vlm, concurrency=4),
        "editor": ScriptedEditor(redraw, id="editor:a"),
        "detector": ScriptedDetector(id="detector:a", max_batch=4),
        "segmenter": ScriptedSegmenter(id=segmenter, max_batch=4),
    }
    agent = A4Agent(
        Dreamer(experts["dreamer"], experts["editor"]),
        Thinker(experts["thinker"]),
        Spotter(experts["detector"], experts["segmenter"]),
    )
    return agent, experts


def asked(experts: dict[str, Any]) -> dict[str, int]:
    return {name: len(expert.requests) for name, expert in experts.items()}


def facts(affordance: Affordance) -> dict[str, Any]:
    """All of an answer but what it took."""
    found = affordance.to_dict()
    for step in found["trace"]:
        step.update(seconds=0.0, cached=False)
    return found


def by_id(agent: A4Agent, queries: Iterator[Query], **settings: Any) -> dict[str, Affordance]:
    return {query.id: affordance for query, affordance in engine.run(agent, queries, **settings)}


def test_a_second_run_asks_nothing_and_answers_the_same(queries: Queries, write: EngineSettings) -> None:
    agent, experts = make_agent()
    plain = by_id(agent, queries(30))
    agent, experts = make_agent()
    first = by_id(agent, queries(30), settings=write)
    assert asked(experts) == dict.fromkeys(experts, 30)
    agent, experts = make_agent()
    stats = Stats()
    second = by_id(agent, queries(30), settings=write, stats=stats)
    assert asked(experts) == dict.fromkeys(experts, 0)
    assert (stats.asked, stats.saved, stats.cost) == (0, 150, 0.0)
    for name, affordance in second.items():
        assert facts(affordance) == facts(first[name]) == facts(plain[name])
        assert all(step.cached for step in affordance.trace.steps)
        assert affordance.trace.cost == 0.0
        assert affordance.imagination is not None
        assert affordance.imagination.image is not None
        assert np.array_equal(affordance.imagination.image, first[name].imagination.image)  # type: ignore[union-attr]


def test_an_ablation_of_the_segmenter_asks_only_the_segmenter(queries: Queries, write: EngineSettings) -> None:
    agent, _ = make_agent()
    list(engine.run(agent, queries(20), settings=write))
    agent, experts = make_agent(segmenter="sam:tiny")
    list(engine.run(agent, queries(20), settings=write))
    assert asked(experts) == {"dreamer": 0, "thinker": 0, "editor": 0, "detector": 0, "segmenter": 20}


def test_an_ablation_of_the_thinker_keeps_the_dreams_and_whatever_comes_out_the_same(
    queries: Queries, write: EngineSettings
) -> None:
    agent, _ = make_agent()
    list(engine.run(agent, queries(20), settings=write))
    agent, experts = make_agent(thinker_vlm="vlm:b")  # names the same part, so nothing after it changes
    list(engine.run(agent, queries(20), settings=write))
    assert asked(experts) == {"dreamer": 0, "thinker": 20, "editor": 0, "detector": 0, "segmenter": 0}


def test_reading_only_adds_nothing_and_off_looks_nowhere(queries: Queries, write: EngineSettings) -> None:
    read = write.model_copy(update={"cache": "read"})
    for settings, calls in ((read, 10), (read, 10), (write, 10), (read, 0), (EngineSettings(), 10)):
        agent, experts = make_agent()
        list(engine.run(agent, queries(10), settings=settings))
        assert asked(experts)["thinker"] == calls


def test_what_is_asked_at_the_same_time_is_asked_once(write: EngineSettings) -> None:
    agent, experts = make_agent()
    for expert in experts.values():
        expert.seconds = 0.01
    same = (Query(str(number), np.zeros((8, 8, 3), np.uint8), "open it") for number in range(40))
    stats = Stats()
    answers = by_id(agent, same, settings=write, stats=stats)
    assert asked(experts) == dict.fromkeys(experts, 1)
    assert stats.saved == 39 * 5
    assert stats.cost == pytest.approx(0.02)
    assert sum(a.trace.cost for a in answers.values()) == pytest.approx(0.02)
    assert {a.status for a in answers.values()} == {"ok"}


def test_those_that_wait_for_an_answer_ask_themselves_when_it_fails(write: EngineSettings) -> None:
    lock, calls = threading.Lock(), [0]

    def once_bad(request: DetectRequest) -> Any:
        time.sleep(0.02)
        with lock:
            calls[0] += 1
            return RequestRejected("not today") if calls[0] == 1 else [[0, 0, 4, 4]]

    agent = A4Agent(None, None, Spotter(ScriptedDetector(once_bad), ScriptedSegmenter()))
    same = (Query(str(number), np.zeros((8, 8, 3), np.uint8), "open it") for number in range(5))
    answers = by_id(agent, same, settings=write)
    assert sorted(a.status for a in answers.values()) == ["error"] + ["ok"] * 4
    assert calls[0] == 2


def test_failures_are_not_kept(queries: Queries, write: EngineSettings) -> None:
    agent = A4Agent(None, None, Spotter(ScriptedDetector(lambda r: RequestRejected("no")), ScriptedSegmenter()))
    assert {a.status for a in by_id(agent, queries(3), settings=write).values()} == {"error"}
    agent = A4Agent(None, None, Spotter(ScriptedDetector(), ScriptedSegmenter()))
    assert {a.status for a in by_id(agent, queries(3), settings=write).values()} == {"ok"}


def test_what_may_pass_is_tried_again_and_counted(queries: Queries) -> None:
    lock, tries = threading.Lock(), dict[str, int]()

    def moody(request: DetectRequest) -> Any:
        with lock:
            tries[request.phrase] = tries.get(request.phrase, 0) + 1
            return ProviderUnavailable("503") if tries[request.phrase] <= 2 else [[0, 0, 4, 4]]

    agent = A4Agent(None, None, Spotter(ScriptedDetector(moody), ScriptedSegmenter()))
    stats = Stats()
    settings = EngineSettings(retry_wait=0.001, in_flight=4)
    answers = by_id(agent, queries(10), settings=settings, stats=stats)
    assert {a.status for a in answers.values()} == {"ok"}
    assert {a.trace.steps[0].attempts for a in answers.values()} == {3}
    assert set(tries.values()) == {3}
    detector = next(e for e in stats.experts.values() if e.role == "detector")
    assert (detector.asked, detector.retries, detector.failures) == (30, 20, 0)


def test_tries_are_limited_and_the_last_reason_is_told() -> None:
    detector = ScriptedDetector(lambda request: ProviderTimeout("no answer in 60 s"))
    agent = A4Agent(None, None, Spotter(detector, ScriptedSegmenter()))
    settings = EngineSettings(retry_wait=0.001, retries=2)
    ((_, affordance),) = engine.run(agent, [Query("a", Image.new("RGB", (8, 8)), "open")], settings=settings)
    assert affordance.status == "error"
    assert affordance.error == "ProviderTimeout: no answer in 60 s"
    assert affordance.trace.steps[0].attempts == len(detector.requests) == 3


@pytest.mark.parametrize("error", [RequestRejected("no"), AnswerError("refused"), ZeroDivisionError("a bug")])
def test_what_will_not_pass_is_not_tried_again(error: Exception) -> None:
    detector = ScriptedDetector(lambda request: error)
    agent = A4Agent(None, None, Spotter(detector, ScriptedSegmenter()))
    ((_, affordance),) = engine.run(agent, [Query("a", Image.new("RGB", (8, 8)), "open")])
    assert affordance.status in ("error", "invalid")
    assert len(detector.requests) == 1


def test_an_outage_costs_no_sample(queries: Queries) -> None:
    """The expert is down for longer than all tries of a request together would last."""
    back = time.monotonic() + 0.6

    def down_for_a_while(request: DetectRequest) -> Any:
        return [[0, 0, 4, 4]] if time.monotonic() > back else ProviderUnavailable("connection refused")

    detector = ScriptedDetector(down_for_a_while, concurrency=4)
    agent = A4Agent(None, None, Spotter(detector, ScriptedSegmenter()))
    answers = by_id(agent, queries(50), settings=EngineSettings(retry_wait=0.01, retries=4))
    assert len(answers) == 50
    assert {a.status for a in answers.values()} == {"ok"}
    assert len(detector.requests) < 50 + 50


def test_an_expert_that_stays_down_stops_the_run(queries: Queries) -> None:
    detector = ScriptedDetector(lambda request: ProviderUnavailable("connection refused"), id="openai:gpt-4o")
    agent = A4Agent(None, None, Spotter(detector, ScriptedSegmenter()))
    settings = EngineSettings(retry_wait=0.005, outage_seconds=0.1)
    with pytest.raises(Exception, match=r"openai:gpt-4o has failed .*connection refused"):
        list(engine.run(agent, queries(1000), settings=settings))
    assert len(detector.requests) < 60


def test_an_outage_is_not_held_against_a_sample_that_failed_before() -> None:
    """With one retry, a failure of the probing calls would end a sample if it counted.

    The first sixteen calls fail before any is repeated, and ten failures open the breaker.
    """

    def down_for_a_while(request: DetectRequest) -> Any:
        return [[0, 0, 4, 4]] if len(detector.requests) > 18 else ProviderUnavailable("connection refused")

    detector = ScriptedDetector(down_for_a_while, concurrency=16)
    agent = A4Agent(None, None, Spotter(detector, ScriptedSegmenter()))
    queries = [Query(str(number), Image.new("RGB", (8, 8)), f"open {number}") for number in range(16)]
    answers = by_id(agent, iter(queries), settings=EngineSettings(retry_wait=0.06, retries=1, in_flight=16))
    assert {a.status for a in answers.values()} == {"ok"}


def limited_once(phrase: str, retry_after: float) -> Callable[[DetectRequest], Any]:
    """An answer function that refuses the first request for `phrase`."""
    refused: list[str] = []

    def answer(request: DetectRequest) -> Any:
        if request.phrase == phrase and not refused:
            refused.append(phrase)
            return RateLimited("slow down", retry_after=retry_after)
        return [[0, 0, 4, 4]]

    return answer


def test_only_the_limited_sample_waits_as_long_as_the_provider_asks(queries: Queries) -> None:
    agent = A4Agent(None, None, Spotter(ScriptedDetector(limited_once("use thing 2", 1.5)), ScriptedSegmenter()))
    started, ended = time.monotonic(), dict[str, float]()
    for query, affordance in engine.run(agent, queries(10), settings=EngineSettings(retry_wait=0.001)):
        assert affordance.status == "ok"
        ended[query.id] = time.monotonic() - started
    limited = ended.pop("q2")
    assert limited >= 1.5
    assert max(ended.values()) < limited


def test_a_provider_cannot_ask_for_a_longer_wait_than_the_setting(queries: Queries) -> None:
    agent = A4Agent(None, None, Spotter(ScriptedDetector(limited_once("use thing 2", 1e5)), ScriptedSegmenter()))
    started = time.monotonic()
    answers = by_id(agent, queries(5), settings=EngineSettings(retry_wait=0.001, max_retry_after=0.2))
    assert {a.status for a in answers.values()} == {"ok"}
    assert 0.2 <= time.monotonic() - started < 10.0


def stopped_while_waiting(detector: ScriptedDetector, queries: Iterator[Query], **settings: Any) -> list[str]:
    """The ids answered by a run that is interrupted after half a second."""
    agent = A4Agent(None, None, Spotter(detector, ScriptedSegmenter()))
    done: list[str] = []
    interrupt = threading.Timer(0.5, signal.raise_signal, (signal.SIGINT,))
    interrupt.start()
    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        done += (query.id for query, _ in engine.run(agent, queries, settings=EngineSettings(**settings)))
    assert time.monotonic() - started < 10.0
    return done


def test_a_stop_ends_the_wait_before_a_retry_and_leaves_that_sample_to_the_next_run(queries: Queries) -> None:
    detector = ScriptedDetector(limited_once("use thing 2", 1e5))
    assert sorted(stopped_while_waiting(detector, queries(5))) == ["q0", "q1", "q3", "q4"]


def test_a_stop_ends_the_wait_for_an_expert_that_is_down(queries: Queries) -> None:
    detector = ScriptedDetector(lambda request: ProviderUnavailable("connection refused"))
    assert stopped_while_waiting(detector, queries(50), retry_wait=20.0, retries=100) == []


def test_what_does_not_fit_into_memory_is_asked_once() -> None:
    detector = ScriptedDetector(lambda request: OutOfMemory("3 GB are missing"))
    agent = A4Agent(None, None, Spotter(detector, ScriptedSegmenter()))
    ((_, affordance),) = engine.run(agent, [Query("a", Image.new("RGB", (8, 8)), "open")])
    assert affordance.error == "OutOfMemory: 3 GB are missing"
    assert len(detector.requests) == 1


class Charging(ScriptedVLM):
    """A VLM that costs money, at a price that may be unknown."""

    def __init__(self, answer: Any, *, price_known: bool = True) -> None:
        super().__init__(answer, id="charging:vlm")
        self.price_known = price_known


def test_a_limit_of_cost_is_refused_for_an_expert_of_unknown_price(queries: Queries) -> None:
    vlm = Charging(lambda request: output("the handle"), price_known=False)
    agent = A4Agent(None, Thinker(vlm), Spotter(ScriptedDetector(), ScriptedSegmenter()))
    with pytest.raises(ConfigError, match="the price of charging:vlm is unknown; set its `price`"):
        list(engine.run(agent, queries(3), settings=EngineSettings(max_cost=1.0)))
    assert vlm.requests == []
    assert len(list(engine.run(agent, queries(3)))) == 3


def test_a_limit_of_cost_ends_with_the_first_answer_of_unknown_cost(queries: Queries) -> None:
    vlm = Charging(lambda request: ChatAnswer(output("the handle")))  # the server left its token counts out
    agent = A4Agent(None, Thinker(vlm), Spotter(ScriptedDetector(), ScriptedSegmenter()))
    done: list[Affordance] = []
    with pytest.raises(BudgetExceeded, match=r"max_cost = 1: charging:vlm answered without its token usage"):
        done += (a for _, a in engine.run(agent, queries(50), settings=EngineSettings(max_cost=1.0)))
    assert len(done) == len(vlm.requests) < 10


def test_an_answer_that_cannot_be_used_keeps_its_cost(queries: Queries) -> None:
    def refuse(request: ChatRequest) -> Any:
        error = RefusedAnswer("I cannot help with that")
        error.usage = Usage(cost=0.05, tokens_in=100)
        return error

    agent = A4Agent(None, Thinker(Charging(refuse)), Spotter(ScriptedDetector(), ScriptedSegmenter()))
    stats, settings, done = Stats(), EngineSettings(max_cost=0.3), list[Affordance]()
    with pytest.raises(BudgetExceeded, match=r"max_cost = 0.3 dollars"):
        done += (a for _, a in engine.run(agent, queries(50), settings=settings, stats=stats))
    assert [a.status for a in done] == ["invalid"] * 6
    assert [a.trace.steps[0].tokens_in for a in done] == [100] * 6
    assert stats.cost == pytest.approx(sum(a.trace.cost for a in done)) == pytest.approx(0.3)


class Crowded(ScriptedDetector):
    """Refuses whatever is more than four calls at once."""

    def __init__(self) -> None:
        super().__init__(id="crowded:detector", concurrency=32)
        self.counter = threading.Lock()
        self.now = self.refused = 0

    def detect(self, requests: Any) -> Any:
        with self.counter:
            self.now += 1
            refuse = self.now > 4
            self.refused += refuse
        time.sleep(0.001 if refuse else 0.005)
        with self.counter:
            self.now -= 1
        return [RateLimited("slow down")] if refuse else super().detect(requests)


def test_a_provider_that_takes_few_calls_at_once_is_asked_no_faster(queries: Queries) -> None:
    detector = Crowded()
    agent = A4Agent(None, None, Spotter(detector, ScriptedSegmenter()))
    answers = by_id(agent, queries(300), settings=EngineSettings(retry_wait=0.02, retries=12))
    assert {a.status for a in answers.values()} == {"ok"}
    assert detector.refused < 150  # with 32 at once and no restraint it is in the thousands


class Encoder(ScriptedSegmenter):
    """A segmenter that tells which images it prepared."""

    def __init__(self) -> None:
        super().__init__(id="sam:x")
        self.prepared: list[int] = []
        self.ready = threading.Event()

    def prepare(self, images: Any) -> None:
        self.prepared += [id(image) for image in images]
        self.ready.set()


def test_the_image_is_encoded_while_the_editor_works(write: EngineSettings) -> None:
    encoder = Encoder()
    overlapped: list[bool] = []

    def redraw(request: EditRequest) -> Image.Image:
        overlapped.append(encoder.ready.wait(5.0))
        return request.image

    def make() -> A4Agent:
        agent = scripted_agent(dream=True)
        assert agent.dreamer is not None
        dreamer = Dreamer(agent.dreamer.vlm, ScriptedEditor(redraw))
        return A4Agent(dreamer, agent.thinker, Spotter(ScriptedDetector(), encoder))

    query = Query("a", np.zeros((8, 8, 3), np.uint8), "open")
    list(engine.run(make(), [query], settings=write))
    assert overlapped == [True]
    assert encoder.prepared == [id(encoder.requests[0].image)]  # the very picture that is segmented later
    list(engine.run(make(), [query], settings=write))
    assert len(encoder.prepared) == 1  # all answers are kept: there is nothing to encode for


def test_enough_samples_are_in_flight_for_the_slowest_expert() -> None:
    def in_flight(agent: A4Agent, **settings: Any) -> int:
        session = EngineSession(agent, EngineSettings(**settings))
        session.close()
        return session.in_flight

    few = A4Agent(None, None, Spotter(ScriptedDetector(), ScriptedSegmenter()))
    many = A4Agent(None, None, Spotter(ScriptedDetector(max_batch=8, concurrency=4), ScriptedSegmenter()))
    huge = A4Agent(None, None, Spotter(ScriptedDetector(concurrency=1000), ScriptedSegmenter()))
    assert in_flight(few) == (1 + 1) + 1 + 2  # what both can hold, the largest once more, and two
    assert in_flight(many) == (8 * 4 + 1) + 8 * 4 + 2
    assert in_flight(huge) == 128
    assert in_flight(huge, in_flight=200) == 200


def test_a_stage_cannot_tell_a_queued_expert_from_its_own() -> None:
    agent, experts = make_agent()
    session = EngineSession(agent, EngineSettings())
    seen: list[Any] = []
    session._agent.with_experts(lambda queued: seen.append(queued) or queued)
    session.close()
    assert {queued.id for queued in seen} == {expert.id for expert in experts.values()}
    for queued in seen:
        own = next(expert for expert in experts.values() if expert.id == queued.id)
        assert (queued.max_batch, queued.concurrency) == (own.max_batch, own.concurrency)
        assert queued.fingerprint() == own.fingerprint()
        for verb in ("chat", "edit", "detect", "segment"):
            assert hasattr(queued, verb) == hasattr(own, verb)


def test_the_chats_of_an_invalid_sample_are_asked_again(write: EngineSettings) -> None:
    query = Query("a", np.zeros((8, 8, 3), np.uint8), "open")
    for text, status, asked_times in (("hm", "invalid", 1), (output("the handle"), "ok", 1), ("hm", "ok", 0)):
        vlm = ScriptedVLM(lambda request, text=text: text, id="vlm:moody")
        agent = A4Agent(None, Thinker(vlm, reasks=0), Spotter(ScriptedDetector(), ScriptedSegmenter()))
        ((_, affordance),) = engine.run(agent, [query], settings=write)
        assert (affordance.status, len(vlm.requests)) == (status, asked_times)


def test_one_expert_in_two_roles_shares_a_queue(queries: Queries) -> None:
    agent = scripted_agent(dream=True)
    assert agent.dreamer is not None
    assert agent.thinker is not None
    assert agent.dreamer.vlm is agent.thinker.vlm
    stats = Stats()
    list(engine.run(agent, queries(10), stats=stats))
    assert stats.experts["vlm scripted:expert"].asked == 20
    assert any("20 asked" in line for line in stats.lines())


def test_an_answer_s_own_attempts_add_up() -> None:
    answers = iter([ProviderUnavailable("503"), Detection(np.zeros((0, 4), np.float32), usage=Usage(attempts=3))])
    agent = A4Agent(None, None, Spotter(ScriptedDetector(lambda request: next(answers)), None))
    query = Query("a", Image.new("RGB", (8, 8)), "open")
    ((_, affordance),) = engine.run(agent, [query], settings=EngineSettings(retry_wait=0.001))
    assert affordance.status == "empty"
    assert affordance.trace.steps[0].attempts == 4


def test_a_stop_ends_the_waits_of_experts_over_http(openai_server: FaultyServer) -> None:
    """The SDK's own pause after `Retry-After: 50` could not be ended; the engine's can."""
    openai_server.replies(lambda call: error(429, "slow down", **{"retry-after": "50"}))
    model = chat.create("m", "vlm", base_url=openai_server.url)
    agent = A4Agent(None, Thinker(model), Spotter(ScriptedDetector([[0, 0, 4, 4]]), ScriptedSegmenter()))
    session = EngineSession(agent, EngineSettings(cache="off"))
    ended: list[BaseException] = []

    def predict() -> None:
        try:
            session.predict(Query("a", Image.new("RGB", (8, 8)), "open"))
        except Unfinished as reason:
            ended.append(reason)

    thread = threading.Thread(target=predict, daemon=True)
    thread.start()
    while not openai_server.calls:
        time.sleep(0.01)
    time.sleep(0.2)
    session.end_waits()
    thread.join(10.0)
    session.close()
    assert len(ended) == 1
    assert len(openai_server.calls) == 1
