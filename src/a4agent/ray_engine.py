"""The same stages on many machines: an actor pool per stage, on Ray Data.

    [ray.dreamer]                    # in a profile: what each stage gets
    replicas = 12                    # actors, each with experts of its own (default 1)
    num_gpus = 1                     # per actor (default 0)
    num_cpus = 2                     # per actor (default 0.5)
    batch = 8                        # samples an actor takes at once (default 16)

An actor builds the experts of its stage alone, from the settings, and asks them as the local engine does:
with batches, retries, breakers and the same cache, so the answers are the same. What travels between the stages
is the query and what is known so far. Nodes need the same package, images that lie where the queries say
and, if answers are kept, a cache folder they share. Ray is found by RAY_ADDRESS; without one it is started here.
"""

from __future__ import annotations

import logging
import os
import pickle
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from typing import Any, cast

from a4agent.agent import A4Agent
from a4agent.config import Settings
from a4agent.engine.pipeline import FINISHING, in_order
from a4agent.engine.session import Session, Until
from a4agent.engine.stats import Stats
from a4agent.engine.stop import Stop
from a4agent.errors import A4Error, BudgetExceeded, ConfigError, ProviderError, UnknownNameError, nearest, require
from a4agent.ray_gate import SharedGate
from a4agent.types import Affordance, Given, Query, Trace

STAGES: dict[str, Until] = {"dreamer": "imagination", "thinker": "target", "spotter": "affordance"}
DEFAULTS = {"replicas": 1.0, "num_cpus": 0.5, "num_gpus": 0.0, "batch": 16.0}
THREADS_END = 10.0
"""Seconds that Ray Data's threads get to end in, before Ray is left to the end of the process."""

log = logging.getLogger("a4agent")


@dataclass(frozen=True)
class _Row:
    """A sample on its way. `answer` is what the stages so far found, `fatal` why no sample could succeed.

    One that is `skipped` was not begun, because the run had stopped.
    """

    number: int
    query: Query
    given: Given
    answer: Affordance | None = None
    fatal: A4Error | None = None
    skipped: bool = False

    @property
    def settled(self) -> bool:
        failed = self.answer is not None and self.answer.status in ("invalid", "error")
        return self.skipped or self.fatal is not None or failed


def run(
    settings: Settings,
    queries: Iterable[Query],
    *,
    ordered: bool = False,
    given: Callable[[Query], Given | None] | None = None,
    stats: Stats | None = None,
) -> Iterator[tuple[Query, Affordance]]:
    """`engine.run` for an agent of these settings, spread over a Ray cluster.

    The queries are read at once, so images should be paths. A run that is to stop begins no more samples and ends
    when those under way have been given; so does the first Ctrl-C, and a second one is raised at once.

    Raises:
        MissingExtraError: ray is not installed.
        ConfigError: a table [ray.STAGE] that does not fit, or a cluster that cannot be reached or is too small.
        UserError, ProviderError, BudgetExceeded: as `engine.run`.
    """
    ray: Any = require("ray", extra="ray")
    pools = {stage: pool_of(settings, stage) for stage in _stages(settings)}
    rows = [_Row(number, query, (given and given(query)) or Given()) for number, query in enumerate(queries)]
    if not rows:
        return
    room, limits = _Room.of(pools), settings.engine
    if limits.max_cost == 0:
        raise _used_up(0.0, Stats(), 0.0, room.least)
    with _connected(ray, pools), Stop() as stop:
        gate = SharedGate(room.most if limits.max_cost is None else room.least)  # until it is known what a sample costs
        with _watched(stop, gate, limits.max_seconds):
            dataset = _dataset(settings, rows, pools, gate)
            answers = _answers(dataset, len(rows), gate, room, stop, limits.max_cost, stats or Stats())
            with closing(answers):
                for _, query, affordance in in_order(answers) if ordered else answers:
                    yield query, affordance
    if stop.reason is not None:
        raise stop.reason


def pool_of(settings: Settings, stage: str) -> dict[str, float]:
    """What an actor pool gets: the table [ray.STAGE] of the settings over the defaults.

    Raises:
        UnknownNameError: a table that is no stage, or a key that is none of replicas, num_cpus, num_gpus, batch.
        ConfigError: no replica, an empty batch, or less than no CPUs or GPUs.
    """
    for name in settings.ray:
        if name not in STAGES:
            raise UnknownNameError(_unknown(f"ray.{name}", name, STAGES))
    table = settings.ray.get(stage, {})
    for key in table:
        if key not in DEFAULTS:
            raise UnknownNameError(_unknown(f"ray.{stage}.{key}", key, DEFAULTS))
    pool = {**DEFAULTS, **table}
    for key, value in pool.items():
        least, whole = (1, True) if key in ("replicas", "batch") else (0, False)
        if value < least or (whole and value % 1):
            number = "a whole number" if whole else "a number"
            raise ConfigError(f"the setting 'ray.{stage}.{key}' is {number} of at least {least}, not {value:g}")
    return pool


def _unknown(setting: str, name: str, known: Iterable[str]) -> str:
    near = nearest(name, known)
    return f"unknown setting {setting!r}; " + (f"did you mean {near!r}?" if near else f"known: {', '.join(known)}.")


def _stages(settings: Settings) -> list[str]:
    return [stage for stage in STAGES if getattr(settings, stage) is not None]


@contextmanager
def _connected(ray: Any, pools: dict[str, dict[str, float]]) -> Generator[None]:
    """Use the Ray that is there, or start one and shut it down again.

    Ray Data's threads outlive what is read from it. One that asks Ray for something after the shutdown starts another
    Ray, or ends this process without a word (ray 2.60). So they are waited for; whoever connected may shut down next.
    """
    started_here = _start(ray)
    before = set(threading.enumerate())
    try:
        _check_size(ray.cluster_resources(), pools)
        yield
    finally:
        if _ended(set(threading.enumerate()) - before) and started_here:
            ray.shutdown()


def _check_size(there: dict[str, float], pools: dict[str, dict[str, float]]) -> None:
    """Ray waits for ever for what no node has, so see that there is room for an actor of each stage."""
    for resource, key in (("CPU", "num_cpus"), ("GPU", "num_gpus")):
        needed, found = sum(pool[key] for pool in pools.values()), there.get(resource, 0.0)
        if needed > found:
            settings = ", ".join(f"ray.{stage}.{key}" for stage in pools)
            raise ConfigError(
                f"an actor for each of {', '.join(pools)} takes {needed:g} {resource}s, and Ray has {found:g}; add"
                f" nodes, or lower {settings}"
            )


def _ended(threads: set[threading.Thread]) -> bool:
    """Wait for threads that nobody waits for at exit; whether they ended."""
    deadline = time.monotonic() + THREADS_END
    for thread in threads - {threading.current_thread()}:
        if thread.daemon and thread.name != "Prefetcher":  # that one idles for ever, and asks nothing
            thread.join(max(deadline - time.monotonic(), 0.0))
            if thread.is_alive():
                return False
    return True


def _start(ray: Any) -> bool:
    """Connect to Ray or start it; returns whether it was started here."""
    if ray.is_initialized():
        return False
    try:
        ray.init(include_dashboard=False, logging_level=logging.ERROR)
    except (ConnectionError, ValueError, RuntimeError) as error:
        where = os.environ.get("RAY_ADDRESS")
        hint = f"is a cluster running at RAY_ADDRESS = {where!r}?" if where else "`ray start --head` says more"
        raise ConfigError(f"Ray cannot be reached: {error}; {hint}") from error
    return True


@dataclass(frozen=True)
class _Room:
    """How many samples are under way: `most` is what all actors work on and as much again that waits.

    A stage waits until its batch is full, so with less than `least`, a batch for each, nothing may move.
    """

    least: int
    most: int

    @classmethod
    def of(cls, pools: dict[str, dict[str, float]]) -> _Room:
        batches = [int(pool["batch"]) for pool in pools.values()]
        return cls(sum(batches) + batches[0], 2 * sum(int(pool["replicas"] * pool["batch"]) for pool in pools.values()))


@contextmanager
def _watched(stop: Stop, gate: SharedGate, max_seconds: float | None) -> Generator[None]:
    """Close the gate as soon as there is a reason to stop; the time being over is one."""
    over, started = threading.Event(), time.monotonic()

    def watch() -> None:
        closed = told = False
        while not over.wait(0.2):
            if max_seconds is not None and time.monotonic() - started >= max_seconds:
                stop.because(
                    BudgetExceeded(f"the budget of engine.max_seconds = {max_seconds:g} is used up; run again to go on")
                )
            if stop.reason is not None and not closed:
                closed = True
                with suppress(Exception):  # Ray is gone: who waits for the answers will meet that, and tell
                    gate.close()
            if stop.interrupted and not told:
                told = True
                log.warning(FINISHING)

    watcher = threading.Thread(target=watch, name="a4 ray", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        over.set()
        watcher.join()


def _dataset(settings: Settings, rows: list[_Row], pools: dict[str, dict[str, float]], gate: SharedGate) -> Any:
    data: Any = require("ray.data", extra="ray")
    data.DataContext.get_current().enable_progress_bars = False
    logging.getLogger("ray.data").setLevel(logging.ERROR)
    first = int(next(iter(pools.values()))["batch"])
    items = [{"row": pickle.dumps(row)} for row in rows]
    # An actor hands on nothing before it is through with a block, so a block holds no more than a batch.
    dataset = data.from_items(items, override_num_blocks=-(-len(items) // first))
    for number, (stage, pool) in enumerate(pools.items()):
        dataset = dataset.map_batches(
            _Stage,
            fn_constructor_args=(settings.model_dump(mode="json"), stage, None if number else gate),
            batch_size=int(pool["batch"]) if number else None,  # None: a block as it is
            batch_format="pyarrow",
            compute=data.ActorPoolStrategy(size=int(pool["replicas"])),
            num_cpus=pool["num_cpus"],
            num_gpus=pool["num_gpus"] or None,
        )
    return dataset


def _packed(rows: Sequence[_Row]) -> Any:
    arrow: Any = require("pyarrow", extra="ray")
    return arrow.table({"row": arrow.array([pickle.dumps(row) for row in rows], arrow.large_binary())})


def _unpacked(table: Any) -> list[_Row]:
    return [pickle.loads(packed) for packed in table["row"].to_pylist()]


def _answers(
    dataset: Any, missing: int, gate: SharedGate, room: _Room, stop: Stop, max_cost: float | None, stats: Stats
) -> Generator[tuple[int, Query, Affordance]]:
    """What comes out of the last stage: all answers, or those under way when there is a reason to stop."""
    dearest = 0.0
    try:
        for table in dataset.iter_batches(batch_size=None, prefetch_batches=0, batch_format="pyarrow"):
            rows = _unpacked(table)
            for row in rows:
                if row.fatal is not None:
                    stop.because(row.fatal)
                elif not row.skipped:
                    affordance = cast(Affordance, row.answer)
                    stats.count_sample(affordance)
                    stats.count_trace(affordance.trace)
                    missing, dearest = missing - 1, max(dearest, affordance.trace.cost)
                    yield row.number, row.query, affordance
            gate.leave([row.number for row in rows])
            if max_cost is not None:
                affordable = int((max_cost - stats.cost) / dearest) if dearest else room.most
                if affordable < min(room.least, missing):
                    stop.because(_used_up(max_cost, stats, dearest, room.least))
                gate.resize(min(affordable, room.most))
            if stop.reason is not None and gate.close() == 0:
                break
    except A4Error:
        raise
    except Exception as error:  # Ray has several trees of its own
        raise ProviderError(f"Ray stopped the run: {error}; what was answered stays, run again to go on") from error
    if not missing and isinstance(stop.reason, BudgetExceeded):
        stop.reason = None  # it was refused nothing


def _used_up(max_cost: float, stats: Stats, dearest: float, least: int) -> BudgetExceeded:
    return BudgetExceeded(
        f"the budget of engine.max_cost = {max_cost:g} dollars is used up: {stats.cost:.4f} spent on"
        f" {stats.samples.total()} samples, and the {least} that fill the batches may cost {dearest:.4f} each;"
        " raise it and run again to go on"
    )


class _Stage:
    """An actor: the experts of one stage behind the local engine's queues. The first stage has the gate."""

    def __init__(self, settings: dict[str, Any], stage: str, gate: SharedGate | None = None) -> None:
        self._until: Until = STAGES[stage]
        self._gate = gate
        self._broken: A4Error | None = None
        try:
            merged = Settings.model_validate(settings)
            limits = merged.engine.model_copy(update={"max_cost": None, "max_seconds": None})
            self._session = Session(A4Agent.from_settings(merged, stages=[stage]), limits)
        except A4Error as error:
            self._broken = error

    def __call__(self, batch: Any) -> Any:
        rows = _unpacked(batch)
        if self._broken is not None:
            rows = [replace(row, fatal=row.fatal or self._broken) for row in rows]
        elif self._let_in(rows):
            with ThreadPoolExecutor(min(len(rows), self._session.in_flight)) as threads:
                rows = list(threads.map(self._advance, rows))
        else:
            rows = [replace(row, skipped=True) for row in rows]
        return _packed(rows)

    def _let_in(self, rows: list[_Row]) -> bool:
        if self._gate is None:
            return True
        while (answer := self._gate.enter([row.number for row in rows])) is None:
            time.sleep(0.1)
        return answer

    def _advance(self, row: _Row) -> _Row:
        if row.settled:
            return row
        known, given = row.answer, row.given
        if known is not None:
            given = replace(given, imagination=known.imagination, target=known.target)
        try:
            answer = self._session.predict(row.query, given, self._until)
        except A4Error as error:
            return replace(row, fatal=error)
        if known is not None:
            answer = replace(answer, trace=Trace(known.trace.steps + answer.trace.steps))
        if self._until != "affordance" and answer.status == "ok":
            answer = replace(answer, image=None)  # the next stage reads the picture itself
        return replace(row, answer=answer)
