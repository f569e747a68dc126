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
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from a4agent import engine
from a4agent import ray_engine as engine_ray
from a4agent.agent import A4Agent
from a4agent.config import STAGES, RaySettings, Settings, load_settings
from a4agent.engine import Stats
from a4agent.errors import BudgetExceeded, ConfigError, CredentialError, UnknownNameError
from a4agent.experts import registry
from a4agent.protocols import VERBS
from a4agent.types import Affordance, Given, Query, Target

ray = pytest.importorskip("ray")

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
        if number % 5 == 3 and model != "steady" and tries.setdefault(number, 0) == 0:
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
        if model.startswith("dies-once-"):
            died = pathlib.Path(model.removeprefix("dies-once-"))
            if not died.exists():
                died.touch()
                os._exit(1)
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
        "ray": {stage: {"num_cpus": 0.25, "batch": 8} for stage in STAGES},
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


class Method:
    """An actor's method that runs at once, in this process; the reference to its result is a function."""

    def __init__(self, method: Callable[..., Any]) -> None:
        self._method = method

    def remote(self, *arguments: Any) -> Callable[[], Any]:
        result = self._method(*arguments)
        return lambda: result


class Handle:
    def __init__(self, settings: Settings, stage: str) -> None:
        actor = engine_ray.StageActor(settings, stage)
        self.about, self.ask = Method(actor.about), Method(actor.ask)


class InProcess:
    """As much of Ray as the driver uses, without other processes."""

    exceptions = ray.exceptions

    def remote(self, **_: Any) -> Any:
        return lambda _: SimpleNamespace(remote=Handle)

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 2.0}

    def wait(self, references: list[Any], **_: Any) -> tuple[list[Any], list[Any]]:
        return references, []

    def get(self, reference: Callable[[], Any]) -> Any:
        return reference()

    def is_initialized(self) -> bool:
        return True

    def kill(self, actor: Handle) -> None: ...


@pytest.fixture
def _in_process(monkeypatch: pytest.MonkeyPatch, _plugin: None) -> None:
    monkeypatch.setattr(engine_ray, "require", lambda module, extra: InProcess())
    monkeypatch.setattr(engine_ray, "send_pictures_as_arrays", lambda: None)


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


def limited(settings: Settings, **limits: Any) -> Settings:
    return settings.model_copy(update={"engine": settings.engine.model_copy(update=limits)})


@pytest.mark.usefixtures("_in_process")
def test_a_budget_of_money_is_kept(settings: Settings, queries: list[Query]) -> None:
    done, stopped = until_stopped(engine_ray.run(limited(settings, max_cost=0.3), queries))
    assert isinstance(stopped, BudgetExceeded)
    assert "max_cost = 0.3 " in str(stopped)
    assert 0.1 < sum(answer.trace.cost for answer in done) < 0.3 + 1e-9


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.usefixtures("_cluster")
def test_the_first_interrupt_lets_what_was_begun_end(settings: Settings, queries: list[Query], tmp_path: Path) -> None:
    table = settings.model_dump(mode="json")
    table["dreamer"]["vlm"]["expert"] = table["thinker"]["vlm"]["expert"] = "plugin:steady"
    steady = Settings.model_validate(table)  # a sample that waits before a retry is not finished
    done, stopped = until_stopped(interrupted(engine_ray.run(limited(steady, in_flight=4), queries)))
    assert isinstance(stopped, KeyboardInterrupt)
    assert len(done) < len(queries)
    asked = calls(tmp_path)
    assert asked.count("editor:e") == sum(any(s.role == "editor" for s in answer.trace.steps) for answer in done)
    assert asked.count("segmenter:s") == sum(answer.status == "ok" for answer in done)


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.usefixtures("_cluster")
def test_what_a_sample_was_answered_before_it_waited_is_not_asked_again(
    settings: Settings, queries: list[Query], tmp_path: Path
) -> None:
    table = settings.model_dump(mode="json")
    table["dreamer"]["vlm"]["expert"] = "plugin:steady"  # the Thinker fails once, when the edited picture is there
    waiting = Settings.model_validate(table)
    some = queries[:4]  # the last one's Thinker has the hiccup
    slow = limited(waiting, in_flight=4, retry_wait=30.0)
    done, stopped = until_stopped(interrupted(engine_ray.run(slow, some)))
    assert isinstance(stopped, KeyboardInterrupt)
    assert {answer.id for answer in done} == {"q0", "q1", "q2"}
    assert calls(tmp_path).count("editor:e") == 4
    answers = {query.id: answer for query, answer in engine_ray.run(waiting, some)}
    assert answers["q3"].status == "ok"
    assert "editor:e" not in calls(tmp_path)


@pytest.mark.usefixtures("_cluster")
def test_a_run_survives_the_death_of_an_actor(settings: Settings, queries: list[Query], tmp_path: Path) -> None:
    table = settings.model_dump(mode="json")
    table["spotter"]["detector"]["expert"] = f"plugin:dies-once-{tmp_path / 'died'}"
    answers = {query.id: answer for query, answer in engine_ray.run(Settings.model_validate(table), queries[:6])}
    assert (tmp_path / "died").exists()
    assert {name: answer.status for name, answer in answers.items()} == {f"q{number}": "ok" for number in range(6)}


@pytest.mark.usefixtures("_cluster")
def test_the_actors_end_with_the_run(settings: Settings, queries: list[Query]) -> None:
    for _ in engine_ray.run(settings, queries):
        break
    deadline = time.monotonic() + 20.0
    while ray.available_resources().get("CPU") != 2.0 and time.monotonic() < deadline:
        time.sleep(0.1)
    assert ray.available_resources().get("CPU") == 2.0


@pytest.mark.usefixtures("_cluster")
def test_a_refused_key_stops_the_run_with_its_reason(settings: Settings, queries: list[Query]) -> None:
    table = settings.model_dump(mode="json")
    table["thinker"]["vlm"]["expert"] = "plugin:locked"
    with pytest.raises(CredentialError, match="the key of this expert is refused"):
        list(engine_ray.run(Settings.model_validate(table), queries))


@pytest.mark.usefixtures("_in_process")
def test_an_expert_shows_one_role_and_as_many_calls_as_its_actors_take(settings: Settings) -> None:
    with engine_ray.agent_on_ray(with_pools(settings, dreamer={"replicas": 3, "batch": 2})) as agent:
        assert agent.dreamer is not None
        editor = agent.dreamer.editor
        assert [role for role, verb in VERBS.items() if hasattr(editor, verb)] == ["editor"]
        assert (editor.id, editor.max_batch, editor.concurrency) == ("plugin:e", 1, 3)
        with agent.from_settings(settings) as local:
            assert [dict(e.fingerprint()) for e in agent.experts()] == [dict(e.fingerprint()) for e in local.experts()]


def test_calls_go_to_the_least_busy_actor_that_has_started() -> None:
    started: list[str] = ["a"]
    fake = SimpleNamespace(wait=lambda references, **_: ([r for r in references if r in started], []))
    actors = engine_ray.Actors(fake, ["A", "B"], {"a": 0, "b": 1})
    with actors.least_busy("detector", 2) as first, actors.least_busy("detector", 2) as second:
        assert (first, second) == ("A", "A")
        started.append("b")
        with actors.least_busy("detector", 2) as third, actors.least_busy("segmenter", 2) as other:
            assert (third, other) == ("B", "A")
    with actors.least_busy("detector", 1) as first, actors.least_busy("detector", 1) as second:
        assert {first, second} == {"A", "B"}
        assert actors._free("detector", 1) is None


@pytest.mark.usefixtures("_in_process")
def test_an_expert_that_cannot_be_built_stops_the_run_with_its_reason(settings: Settings, queries: list[Query]) -> None:
    table = settings.model_dump(mode="json")
    table["thinker"]["vlm"]["expert"] = "plugin-that-is-not-there:x"
    with pytest.raises(UnknownNameError, match="plugin-that-is-not-there"):
        list(engine_ray.run(Settings.model_validate(table), queries))


def with_pools(settings: Settings, **pools: dict[str, float]) -> Settings:
    return settings.model_copy(update={"ray": RaySettings.model_validate(pools)})


@pytest.mark.usefixtures("_cluster")
def test_a_cluster_that_is_too_small_is_told_at_once(settings: Settings, queries: list[Query]) -> None:
    """Ray itself would wait for a node to come."""
    greedy = with_pools(settings, spotter={"num_gpus": 1, "num_cpus": 0.25})
    with pytest.raises(ConfigError, match=r"takes 1 GPUs, and Ray has 0; .*ray.spotter.num_gpus"):
        list(engine_ray.run(greedy, queries))


def test_the_example_of_a_cluster_fits() -> None:
    example = load_settings(Path(__file__).parents[1] / "examples" / "cluster.toml", environ={})
    assert [getattr(example.ray, stage).replicas for stage in STAGES[:3]] == [24, 2, 4]
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
