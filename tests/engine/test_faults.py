"""A thousand samples, three in ten of which meet a fault on the way: one answer each, and the right one.

The Thinker asks a real HTTP server that answers 429, 500, too late, half, with garbage or against the schema;
the detector and segmenter fail, hang and run out of memory by themselves. What passes leaves no trace in the
answers; what does not pass is told for that sample alone.
"""

from __future__ import annotations

import re
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from a4agent import engine
from a4agent.agent import A4Agent
from a4agent.engine import EngineSettings, Stats
from a4agent.errors import OutOfMemory, ProviderTimeout, ProviderUnavailable, RateLimited
from a4agent.experts.remote.chat import create
from a4agent.imaging.masks import encode_rle
from a4agent.protocols import DetectRequest, SegmentRequest
from a4agent.stages.spotter import Spotter
from a4agent.stages.thinker import Thinker
from a4agent.testing import ScriptedDetector, ScriptedSegmenter, output
from a4agent.types import Affordance, Query
from servers import Call, FaultyServer, Reply, chat, error

SAMPLES = 1000
HANG = 3.0
FAULTS = ("429", "500", "hang", "cut-off", "garbage", "wrong schema")
FAULTY = {f"{number:04d}": FAULTS[number % 20] for number in range(SAMPLES) if number % 20 < len(FAULTS)}
"""Sample -> what goes wrong the first time it is asked about: 5% of the samples each."""
HOPELESS = {f"{number:04d}": FAULTS[number // 111 % 6] for number in range(19, SAMPLES, 111)}
"""Sample -> what goes wrong every time."""


def queries() -> Iterator[Query]:
    for number in range(SAMPLES):
        picture = np.full((24, 32, 3), 255, np.uint8)
        picture[..., 0], picture[..., 1] = number % 256, number // 256
        yield Query(f"{number:04d}", picture, f"use thing {number:04d}")


class Faults:
    """Says what is wrong with each request about a sample, and counts the requests."""

    def __init__(self, on: bool) -> None:
        self.on = on
        self.asked: Counter[str] = Counter()
        self._lock = threading.Lock()

    def next(self, sample: str) -> str | None:
        with self._lock:
            self.asked[sample] += 1
            first = self.asked[sample] == 1
        if not self.on:
            return None
        return HOPELESS.get(sample) or (FAULTY.get(sample) if first else None)


def thinker_server(server: FaultyServer, faults: Faults) -> None:
    def reply(call: Call) -> Reply:
        text = call.json["messages"][-1]["content"][-1]["text"]
        sample = re.findall(r"use thing (\d{4})", text)[0]
        good = output(f"part {sample}", task=f"use thing {sample}")
        match faults.next(sample):
            case "429":
                return error(429, "slow down", retry_after="0.005")
            case "500":
                return error(500, "internal error")
            case "hang":
                return Reply(chat(good).body, delay=HANG)
            case "cut-off":
                return Reply(chat(good).body, headers={"content-type": "application/json"}, cut=True)
            case "garbage":
                return chat("as a large language model, I { see a [ thing")
            case "wrong schema":
                return chat('### Output\n{"task": "use it", "part": ["the", "handle"]}')
            case _:
                return chat(good)

    server.replies(reply)


def number_of(image: Image.Image) -> int:
    red, green, _ = image.getpixel((0, 0))  # type: ignore[misc]
    return red + 256 * green


class FaultyDetector(ScriptedDetector):
    """Fails for single requests and runs out of memory on batches of more than two."""

    def __init__(self, faults: Faults) -> None:
        super().__init__(self._find, id="faulty:detector", max_batch=8, concurrency=4)
        self.faults = faults

    def detect(self, requests: Sequence[DetectRequest]) -> Any:
        if self.faults.on and len(requests) > 2:
            raise OutOfMemory(f"{len(requests)} do not fit")
        return super().detect(requests)

    def _find(self, request: DetectRequest) -> Any:
        number = number_of(request.image)
        match self.faults.next(f"{number:04d}"):
            case "429":
                return RateLimited("slow down", retry_after=0.005)
            case "500":
                return ProviderUnavailable("internal error")
            case "hang":
                return ProviderTimeout("no answer in time")
            case _:
                return [[number % 20, number % 15, number % 20 + 6, number % 15 + 7]]


class FaultySegmenter(ScriptedSegmenter):
    """Raises for a whole batch what concerns one request of it."""

    def __init__(self, faults: Faults) -> None:
        super().__init__(id="faulty:segmenter", max_batch=4)
        self.faults = faults

    def segment(self, requests: Sequence[SegmentRequest]) -> Any:
        for request in requests:
            if self.faults.next(f"{number_of(request.image):04d}") == "500":
                raise ProviderUnavailable("internal error")
        return super().segment(requests)


def run(server: FaultyServer, cache: Path, *, faulty: bool) -> tuple[dict[str, Affordance], Counter[str], Stats]:
    thinker_server(server, Faults(faulty))
    vlm = create("m", "vlm", base_url=server.url, timeout=0.4, max_retries=0, concurrency=16)
    spotter = Spotter(FaultyDetector(Faults(faulty)), FaultySegmenter(Faults(faulty)))
    # Ten failures in a row are rare at three in ten, but not over thousands of calls of shrinking batches.
    settings = EngineSettings(cache="write", cache_dir=cache, retry_wait=0.01, retries=4)
    answers: dict[str, Affordance] = {}
    given: Counter[str] = Counter()
    stats = Stats()
    with A4Agent(None, Thinker(vlm), spotter) as agent:
        for query, affordance in engine.run(agent, queries(), settings=settings, stats=stats):
            given[query.id] += 1
            answers[query.id] = affordance
    return answers, given, stats


def test_a_thousand_samples_meet_faults_and_lose_nothing(openai_server: FaultyServer, tmp_path: Path) -> None:
    calm, _, _ = run(openai_server, tmp_path / "calm", faulty=False)
    stormy, given, stats = run(openai_server, tmp_path / "stormy", faulty=True)

    assert given == Counter({f"{number:04d}": 1 for number in range(SAMPLES)})  # one answer each, none twice
    for sample, answer in stormy.items():
        if sample in HOPELESS:
            expected = "invalid" if HOPELESS[sample] in ("garbage", "wrong schema") else "error"
            assert answer.status == expected, (sample, HOPELESS[sample], answer.error)
            continue
        assert answer.status == calm[sample].status == "ok", (sample, answer.error)
        assert answer.target == calm[sample].target
        assert encode_rle(answer.mask) == encode_rle(calm[sample].mask)
    for sample in sorted(set(FAULTY) - set(HOPELESS)):
        steps = stormy[sample].trace.steps
        asked_again = sum(step.attempts for step in steps) > len(steps) or len(steps) > len(calm[sample].trace.steps)
        assert asked_again, (sample, FAULTY[sample])
    assert sum(expert.retries for expert in stats.experts.values()) >= 4 * SAMPLES // 20
    assert stats.samples["ok"] == SAMPLES - len(HOPELESS)

    # Another run finds the answers of all that went well, and asks about the others alone.
    again, _, stats = run(openai_server, tmp_path / "stormy", faulty=False)
    assert {answer.status for answer in again.values()} == {"ok"}
    assert {e.role: e.asked for e in stats.experts.values()} == {
        "vlm": len(HOPELESS),
        "detector": len(HOPELESS),
        "segmenter": len(HOPELESS),
    }


def test_calls_that_hang_for_good_are_left_behind(openai_server: FaultyServer) -> None:
    """No time limit of the expert's own: the engine's ends the wait, and the run goes on with other threads."""

    def reply(call: Call) -> Reply:
        sample = re.findall(r"use thing (\d{4})", call.json["messages"][-1]["content"][-1]["text"])[0]
        return Reply(chat(output("part")).body, delay=20.0 if int(sample) % 20 == 7 else 0.0)

    openai_server.replies(reply)
    vlm = create("m", "vlm", base_url=openai_server.url, timeout=60.0, max_retries=0, concurrency=4)
    agent = A4Agent(None, Thinker(vlm), Spotter(ScriptedDetector(), ScriptedSegmenter()))
    settings = EngineSettings(max_sample_seconds=2.5)
    some = [query for query in queries() if int(query.id) < 120]
    answers = {query.id: answer for query, answer in engine.run(agent, some, settings=settings)}
    openai_server.close()
    agent.close()
    assert len(answers) == 120
    late = sorted(name for name, answer in answers.items() if answer.status == "error")
    assert late == [f"{number:04d}" for number in range(7, 120, 20)]
    assert all("max_sample_seconds" in (answers[name].error or "") for name in late)


def test_faults_are_a_twentieth_each() -> None:
    assert Counter(FAULTY.values()) == dict.fromkeys(FAULTS, SAMPLES // 20)
    assert len(set(HOPELESS.values())) >= 4
