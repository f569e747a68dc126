"""A Ray of two CPUs answers as the local engine does, with the same cache, and says the same when nothing can work.

The experts come from a package of entry points that this test installs into a folder: actors are processes of
their own and find it as they would find anyone's.
"""

from __future__ import annotations

import importlib
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from a4agent import engine
from a4agent import ray_engine as engine_ray
from a4agent.agent import A4Agent
from a4agent.config import Settings, load_settings
from a4agent.engine import Stats
from a4agent.errors import BudgetExceeded, ConfigError, CredentialError, UnknownNameError
from a4agent.experts import registry
from a4agent.ray_gate import Gate
from a4agent.types import Affordance, Given, Query, Target

ray = pytest.importorskip("ray")
pyarrow = pytest.importorskip("pyarrow")

pytestmark = [
    # Ray's own: it forks, and leaves sockets and files to its exit.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore:.*:DeprecationWarning:ray.*"),
    pytest.mark.filterwarnings("ignore:.*RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO.*:FutureWarning"),
]

PLUGIN = """
import os, pathlib, zlib
import numpy as np
from a4agent.errors import CredentialError, ProviderUnavailable
from a4agent.protocols import ChatAnswer, Usage
from a4agent.testing import ScriptedDetector, ScriptedEditor, ScriptedSegmenter, ScriptedVLM, output

def note(log, what):
    if log:
        with open(log, "a") as file:
            file.write(what + "\\n")

def create(model, role, *, log=""):
    tries = {}

    def chat(request):
        note(log, f"{role}:{model}")
        number = int(np.asarray(request.images[0])[0, 0, 0])
        if model == "locked":
            return CredentialError("the key of this expert is refused")
        if number % 5 == 3 and tries.setdefault(number, 0) == 0:
            tries[number] = 1
            return ProviderUnavailable("a hiccup")
        if "### Output" not in request.text:
            return ChatAnswer(f"Edit it. {request.text[-20:]}", usage=Usage(cost=0.01))
        if number % 7 == 6:
            return ChatAnswer("I cannot tell.")
        seen = zlib.crc32(b"".join(image.tobytes() for image in request.images)) % 10
        return ChatAnswer(output(f"part {seen}"), usage=Usage(cost=0.01))

    def edit(request):
        note(log, f"{role}:{model}")
        return request.image.rotate(180)

    def detect(request):
        note(log, f"{role}:{model}")
        shift = int(request.phrase.split()[-1])
        return [[shift, 1, shift + 5, 9]]

    def segment(request):
        note(log, f"{role}:{model}")
        from a4agent.testing import fill_boxes
        return fill_boxes(request)

    make = {"vlm": (ScriptedVLM, chat), "editor": (ScriptedEditor, edit), "detector": (ScriptedDetector, detect),
            "segmenter": (ScriptedSegmenter, segment)}
    kind, answer = make[role]
    return kind(answer, id=f"plugin:{model}", max_batch=1 if role == "editor" else 4)
"""


@pytest.fixture(scope="module")
def _plugin(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    site = tmp_path_factory.mktemp("site")
    (site / "ray_test_plugin.py").write_text(PLUGIN)
    info = site / "ray_test_plugin-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: ray-test-plugin\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[a4agent.experts]\nplugin = ray_test_plugin:create\n")
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(site), before]))
    sys.path.insert(0, str(site))
    importlib.invalidate_caches()
    registry.plugins.forget()
    yield
    sys.path.remove(str(site))
    registry.plugins.forget()
    os.environ.pop("PYTHONPATH")
    if before is not None:
        os.environ["PYTHONPATH"] = before


@pytest.fixture(scope="module")
def _cluster(_plugin: None) -> Iterator[None]:
    logging.getLogger("ray").setLevel(logging.ERROR)
    ray.init(
        num_cpus=2,
        include_dashboard=False,
        logging_level=logging.ERROR,
        log_to_driver=False,
        object_store_memory=150 * 2**20,
    )
    yield
    ray.shutdown()


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    log = str(tmp_path / "calls.log")
    table: dict[str, Any] = {
        "name": "test",
        "dreamer": {"vlm": {"expert": "plugin:a", "log": log}, "editor": {"expert": "plugin:e", "log": log}},
        "thinker": {"vlm": {"expert": "plugin:b", "log": log}},
        "spotter": {
            "detector": {"expert": "plugin:d", "log": log},
            "segmenter": {"expert": "plugin:s", "log": log},
        },
        "engine": {"retry_wait": 0.01, "cache": "write", "cache_dir": str(tmp_path / "cache")},
        "ray": {stage: {"num_cpus": 0.25, "batch": 8} for stage in engine_ray.STAGES},
    }
    return Settings.model_validate(table)


@pytest.fixture
def queries(tmp_path: Path) -> list[Query]:
    found: list[Query] = []
    for number in range(24):
        path = tmp_path / f"{number}.png"
        Image.fromarray(np.full((12, 16, 3), (number, 7, 9), np.uint8)).save(path)
        found.append(Query(f"q{number}", path, f"use thing {number}"))
    return [*found, Query("gone", tmp_path / "gone.png", "open"), Query("blank", found[0].image, " ")]


def calls(tmp_path: Path) -> list[str]:
    log = tmp_path / "calls.log"
    found = log.read_text().splitlines() if log.exists() else []
    log.unlink(missing_ok=True)
    return sorted(found)


def row(affordance: Affordance) -> dict[str, Any]:
    """What a run keeps of an answer, but the seconds."""
    found = affordance.to_dict()
    for step in found["trace"]:
        step["seconds"] = 0.0
    return found


@pytest.mark.usefixtures("_cluster")
def test_rows_are_the_same_as_the_local_engine_s_and_so_is_the_cache(
    settings: Settings, queries: list[Query], tmp_path: Path
) -> None:
    elsewhere = settings.model_copy(
        update={"engine": settings.engine.model_copy(update={"cache_dir": tmp_path / "other"})}
    )
    with A4Agent.from_settings(elsewhere) as agent:
        local = dict(engine.run(agent, queries, settings=elsewhere.engine))
    local_calls = calls(tmp_path)
    stats = Stats()
    spread = {query.id: answer for query, answer in engine_ray.run(settings, queries, stats=stats)}
    assert calls(tmp_path) == local_calls
    assert len(spread) == len(local) == len(queries)
    assert {answer.status for answer in spread.values()} == {"ok", "invalid", "error"}
    for query, answer in local.items():
        assert row(spread[query.id]) == row(answer), query.id
    assert stats.samples.total() == len(queries)
    assert stats.cost == pytest.approx(sum(answer.trace.cost for answer in spread.values()))
    assert sum(expert.retries for expert in stats.experts.values()) > 0

    # The local engine finds what the actors have kept.
    with A4Agent.from_settings(settings) as agent:
        again = {q.id: a for q, a in engine.run(agent, queries, settings=settings.engine)}
    for name, answer in again.items():
        if answer.status == "ok":
            assert all(step.cached for step in answer.trace.steps)
            assert np.array_equal(answer.mask, spread[name].mask)
    assert set(calls(tmp_path)) <= {"vlm:a", "vlm:b", "editor:e"}  # of the samples that came to nothing


class InProcess:
    """A dataset whose stages run here, in the order of Ray's operators: the logic without the start of actors."""

    def __init__(self, settings: Settings, rows: list[Any], pools: dict[str, dict[str, float]], gate: Gate) -> None:
        self._rows = rows
        self._batch = int(next(iter(pools.values()))["batch"])
        self._actors = [
            engine_ray._Stage(settings.model_dump(mode="json"), stage, None if number else gate)  # type: ignore[arg-type]
            for number, stage in enumerate(pools)
        ]

    def iter_batches(self, **_: Any) -> Iterator[Any]:
        try:
            for start in reversed(range(0, len(self._rows), self._batch)):
                table = engine_ray._packed(self._rows[start : start + self._batch])
                for actor in self._actors:
                    table = actor(table)
                yield table
        finally:
            for actor in self._actors:
                if actor._broken is None:
                    actor._session.close()


@pytest.fixture
def _in_process(monkeypatch: pytest.MonkeyPatch, _plugin: None) -> None:
    monkeypatch.setattr(engine_ray, "_dataset", InProcess)
    monkeypatch.setattr(engine_ray, "_connected", lambda ray, pools: nullcontext())
    monkeypatch.setattr(engine_ray, "SharedGate", Gate)


@pytest.mark.usefixtures("_in_process")
def test_given_answers_and_order(settings: Settings, queries: list[Query], tmp_path: Path) -> None:
    given = Given(target=Target("t", "o", "part 3"))
    answers = list(engine_ray.run(settings, queries[:9], given=lambda query: given, ordered=True))
    assert [query.id for query, _ in answers] == [f"q{number}" for number in range(9)]
    assert {answer.target.object_part for _, answer in answers if answer.target} == {"part 3"}
    assert set(calls(tmp_path)) == {"detector:d", "segmenter:s"}


def until_stopped(answers: Iterator[tuple[Query, Affordance]]) -> tuple[list[Affordance], BaseException | None]:
    done: list[Affordance] = []
    try:
        for _, affordance in answers:
            done.append(affordance)
    except (Exception, KeyboardInterrupt) as error:
        return done, error
    return done, None


def interrupted(answers: Iterator[tuple[Query, Affordance]]) -> Iterator[tuple[Query, Affordance]]:
    """Ctrl-C when the first answer has come."""
    yield next(answers)
    signal.raise_signal(signal.SIGINT)
    yield from answers


def limited(settings: Settings, **limits: float) -> Settings:
    return settings.model_copy(update={"engine": settings.engine.model_copy(update=limits)})


@pytest.mark.usefixtures("_in_process")
def test_a_budget_of_money_is_kept(settings: Settings, queries: list[Query]) -> None:
    done, stopped = until_stopped(engine_ray.run(limited(settings, max_cost=0.3), queries))
    assert isinstance(stopped, BudgetExceeded)
    assert "max_cost = 0.3 " in str(stopped)
    assert 0.1 < sum(answer.trace.cost for answer in done) <= 0.3


@pytest.mark.usefixtures("_in_process")
def test_a_budget_has_room_for_all_actors_once_it_is_known_what_a_sample_costs(
    settings: Settings, queries: list[Query], monkeypatch: pytest.MonkeyPatch
) -> None:
    rooms: list[int] = []

    class Told(Gate):
        def __init__(self, room: int) -> None:
            rooms.append(room)
            super().__init__(room)

        def resize(self, room: int) -> None:
            rooms.append(room)
            super().resize(room)

    monkeypatch.setattr(engine_ray, "SharedGate", Told)
    list(engine_ray.run(limited(settings, max_cost=100.0), queries[:9]))
    assert rooms == [32, 48, 48]  # a batch of 8 for each of three stages and one more; twice what all actors hold


@pytest.mark.usefixtures("_in_process")
def test_no_money_begins_no_sample(settings: Settings, queries: list[Query], tmp_path: Path) -> None:
    with pytest.raises(BudgetExceeded, match="max_cost = 0 "):
        next(engine_ray.run(limited(settings, max_cost=0.0), queries))
    assert calls(tmp_path) == []


@pytest.mark.usefixtures("_in_process")
@pytest.mark.parametrize("limits", [{"max_cost": 0.6}, {"max_seconds": 0.01}])
def test_a_budget_that_refused_nothing_stops_nothing(
    settings: Settings, queries: list[Query], limits: dict[str, float]
) -> None:
    some = queries if "max_cost" in limits else queries[:8]
    answers = engine_ray.run(limited(settings, **limits), some)
    done = [next(answers)]
    time.sleep(0.5)  # the time is over when the last are given
    assert len(done + list(answers)) == len(some)


@pytest.mark.usefixtures("_in_process")
def test_a_budget_of_time_begins_no_more(settings: Settings, queries: list[Query]) -> None:
    answers = engine_ray.run(limited(settings, max_seconds=0.01), queries)
    next(answers)
    time.sleep(0.5)
    done, stopped = until_stopped(answers)
    assert isinstance(stopped, BudgetExceeded)
    assert "max_seconds = 0.01" in str(stopped)
    assert 1 + len(done) == 2  # the first batch that the stub answers is the last one, of two


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.usefixtures("_cluster")
def test_the_first_interrupt_lets_what_was_begun_end(settings: Settings, queries: list[Query], tmp_path: Path) -> None:
    settings = settings.model_copy(update={"ray": {stage: {"num_cpus": 0.25, "batch": 2} for stage in settings.ray}})
    done, stopped = until_stopped(interrupted(engine_ray.run(settings, queries)))
    assert isinstance(stopped, KeyboardInterrupt)
    assert len(done) < len(queries)
    asked = calls(tmp_path)
    assert asked.count("editor:e") == sum(any(s.role == "editor" for s in answer.trace.steps) for answer in done)
    assert asked.count("segmenter:s") == sum(answer.status == "ok" for answer in done)


@pytest.mark.usefixtures("_cluster")
def test_who_stops_early_leaves_no_thread_that_may_ask_ray_after_its_end(
    settings: Settings, queries: list[Query]
) -> None:
    """Ray ends the process of such a thread, or starts another Ray for it."""
    before = set(threading.enumerate())
    for _ in engine_ray.run(settings, queries):
        break
    assert {thread.name for thread in set(threading.enumerate()) - before} <= {"Prefetcher"}


@pytest.mark.usefixtures("_cluster")
def test_a_refused_key_stops_the_run_with_its_reason(settings: Settings, queries: list[Query]) -> None:
    table = settings.model_dump(mode="json")
    table["thinker"]["vlm"]["expert"] = "plugin:locked"
    with pytest.raises(CredentialError, match="the key of this expert is refused"):
        list(engine_ray.run(Settings.model_validate(table), queries))


@pytest.mark.usefixtures("_in_process")
def test_an_expert_that_cannot_be_built_stops_the_run_with_its_reason(settings: Settings, queries: list[Query]) -> None:
    table = settings.model_dump(mode="json")
    table["thinker"]["vlm"]["expert"] = "plugin-that-is-not-there:x"
    with pytest.raises(UnknownNameError, match="plugin-that-is-not-there"):
        list(engine_ray.run(Settings.model_validate(table), queries))


def test_pools_come_from_the_settings(settings: Settings) -> None:
    def changed(**tables: dict[str, float]) -> Settings:
        return settings.model_copy(update={"ray": tables})

    assert engine_ray.pool_of(changed(), "thinker") == {"replicas": 1, "num_cpus": 0.5, "num_gpus": 0, "batch": 16}
    assert engine_ray.pool_of(changed(dreamer={"replicas": 12, "num_gpus": 1}), "dreamer") == {
        "replicas": 12,
        "num_cpus": 0.5,
        "num_gpus": 1,
        "batch": 16,
    }
    with pytest.raises(UnknownNameError, match="did you mean 'dreamer'"):
        engine_ray.pool_of(changed(dreamers={"replicas": 2}), "dreamer")
    with pytest.raises(UnknownNameError, match="did you mean 'num_gpus'"):
        engine_ray.pool_of(changed(dreamer={"gpus": 2}), "dreamer")
    for key, value in (("replicas", 0), ("replicas", 1.5), ("batch", 0), ("num_cpus", -1), ("num_gpus", -0.5)):
        with pytest.raises(ConfigError, match=f"ray.dreamer.{key}.*not {value}"):
            engine_ray.pool_of(changed(dreamer={key: value}), "dreamer")


@pytest.mark.usefixtures("_cluster")
def test_a_cluster_that_is_too_small_is_told_at_once(settings: Settings, queries: list[Query]) -> None:
    """Ray itself would wait for a node to come."""
    greedy = settings.model_copy(update={"ray": {"spotter": {"num_gpus": 1, "num_cpus": 0.25}}})
    with pytest.raises(ConfigError, match=r"takes 1 GPUs, and Ray has 0; .*ray.spotter.num_gpus"):
        list(engine_ray.run(greedy, queries))


def test_the_example_of_a_cluster_fits() -> None:
    example = load_settings(Path(__file__).parents[1] / "examples" / "cluster.toml", environ={})
    assert {stage: engine_ray.pool_of(example, stage)["replicas"] for stage in engine_ray.STAGES} == {
        "dreamer": 24,
        "thinker": 2,
        "spotter": 4,
    }
    assert example.engine.cache_dir is not None


def test_a_cluster_that_is_not_there_is_named(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**_: Any) -> None:
        raise ConnectionError("Failed to connect")

    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setattr(ray, "init", refuse)
    monkeypatch.setenv("RAY_ADDRESS", "node0:6379")
    with pytest.raises(ConfigError, match="node0:6379"):
        list(engine_ray.run(settings, [Query("a", "a.png", "open")]))


def test_no_queries_start_no_cluster(settings: Settings) -> None:
    assert list(engine_ray.run(settings, [])) == []
