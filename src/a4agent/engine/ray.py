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
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, cast

from a4agent.affordance import Affordance, Given, Query, Trace
from a4agent.agent import A4Agent
from a4agent.config import Settings
from a4agent.engine.pipeline import in_order
from a4agent.engine.session import Session, Until
from a4agent.engine.stats import Stats
from a4agent.errors import A4Error, BudgetExceeded, ConfigError, ProviderError, UnknownNameError, nearest, require

STAGES: dict[str, Until] = {"dreamer": "imagination", "thinker": "target", "spotter": "affordance"}
DEFAULTS = {"replicas": 1.0, "num_cpus": 0.5, "num_gpus": 0.0, "batch": 16.0}


@dataclass(frozen=True)
class _Row:
    """A sample on its way. `answer` is what the stages so far found, `fatal` why no sample could succeed."""

    number: int
    query: Query
    given: Given
    answer: Affordance | None = None
    fatal: A4Error | None = None

    @property
    def settled(self) -> bool:
        return self.fatal is not None or (self.answer is not None and self.answer.status in ("invalid", "error"))


def run(
    settings: Settings,
    queries: Iterable[Query],
    *,
    ordered: bool = False,
    given: Callable[[Query], Given | None] | None = None,
    stats: Stats | None = None,
) -> Iterator[tuple[Query, Affordance]]:
    """`engine.run` for an agent of these settings, spread over a Ray cluster.

    The queries are read at once, so images should be paths. Budgets are checked as answers arrive; samples
    that are under way when a run stops are not waited for, but what their models said is in the cache.

    Raises:
        MissingExtraError: ray is not installed.
        ConfigError: a table [ray.STAGE] that does not fit.
        UserError, ProviderError, BudgetExceeded: as `engine.run`.
    """
    ray: Any = require("ray", extra="ray")
    pools = {stage: pool_of(settings, stage) for stage in _stages(settings)}
    rows = [_Row(number, query, (given and given(query)) or Given()) for number, query in enumerate(queries)]
    if not rows:
        return
    started_here = _start(ray)
    try:
        answers = _answers(_dataset(settings, rows, pools), settings, stats or Stats())
        for _, query, affordance in in_order(answers) if ordered else answers:
            yield query, affordance
    finally:
        if started_here:
            ray.shutdown()


def pool_of(settings: Settings, stage: str) -> dict[str, float]:
    """What an actor pool gets: the table [ray.STAGE] of the settings over the defaults.

    Raises:
        UnknownNameError: a table that is no stage, or a key that is none of replicas, num_cpus, num_gpus, batch.
        ConfigError: no replica or an empty batch.
    """
    for name in settings.ray:
        if name not in STAGES:
            raise UnknownNameError(_unknown(f"ray.{name}", name, STAGES))
    table = settings.ray.get(stage, {})
    for key in table:
        if key not in DEFAULTS:
            raise UnknownNameError(_unknown(f"ray.{stage}.{key}", key, DEFAULTS))
    pool = {**DEFAULTS, **table}
    for key in ("replicas", "batch"):
        if pool[key] < 1:
            raise ConfigError(f"the setting 'ray.{stage}.{key}' is at least 1, not {pool[key]:g}")
    return pool


def _unknown(setting: str, name: str, known: Iterable[str]) -> str:
    near = nearest(name, known)
    return f"unknown setting {setting!r}; " + (f"did you mean {near!r}?" if near else f"known: {', '.join(known)}.")


def _stages(settings: Settings) -> list[str]:
    return [stage for stage in STAGES if getattr(settings, stage) is not None]


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


def _dataset(settings: Settings, rows: list[_Row], pools: dict[str, dict[str, float]]) -> Any:
    data: Any = require("ray.data", extra="ray")
    data.DataContext.get_current().enable_progress_bars = False
    logging.getLogger("ray.data").setLevel(logging.ERROR)
    dataset = data.from_items([{"row": pickle.dumps(row)} for row in rows])
    for stage, pool in pools.items():
        dataset = dataset.map_batches(
            _Stage,
            fn_constructor_args=(settings.model_dump(mode="json"), stage),
            batch_size=int(pool["batch"]),
            batch_format="pyarrow",
            compute=data.ActorPoolStrategy(size=int(pool["replicas"])),
            num_cpus=pool["num_cpus"],
            num_gpus=pool["num_gpus"] or None,
        )
    return dataset


def _answers(dataset: Any, settings: Settings, stats: Stats) -> Iterator[tuple[int, Query, Affordance]]:
    """What comes out of the last stage, until a budget is used up or a row says that nothing can succeed."""
    limits, started = settings.engine, time.monotonic()
    try:
        for item in dataset.iter_rows():
            row: _Row = pickle.loads(item["row"])
            if row.fatal is not None:
                raise row.fatal
            affordance = cast(Affordance, row.answer)
            stats.count_sample(affordance)
            stats.count_trace(affordance.trace)
            yield row.number, row.query, affordance
            if limits.max_cost is not None and stats.cost >= limits.max_cost:
                raise BudgetExceeded(
                    f"the budget of engine.max_cost = {limits.max_cost:g} dollars is used up: {stats.cost:.4f} spent on"
                    f" {sum(stats.samples.values())} samples; raise it and run again to go on"
                )
            if limits.max_seconds is not None and time.monotonic() - started >= limits.max_seconds:
                raise BudgetExceeded(
                    f"the budget of engine.max_seconds = {limits.max_seconds:g} is used up:"
                    f" {sum(stats.samples.values())} samples ended; run again to go on"
                )
    except A4Error:
        raise
    except Exception as error:  # Ray has several trees of its own
        raise ProviderError(f"Ray stopped the run: {error}; what was answered stays, run again to go on") from error


class _Stage:
    """An actor: the experts of one stage behind the local engine's queues."""

    def __init__(self, settings: dict[str, Any], stage: str) -> None:
        self._until: Until = STAGES[stage]
        self._broken: A4Error | None = None
        try:
            merged = Settings.model_validate(settings)
            limits = merged.engine.model_copy(update={"max_cost": None, "max_seconds": None})
            self._session = Session(A4Agent.from_settings(merged, stages=[stage]), limits)
        except A4Error as error:
            self._broken = error

    def __call__(self, batch: Any) -> Any:
        arrow: Any = require("pyarrow", extra="ray")
        rows: list[_Row] = [pickle.loads(packed) for packed in batch["row"].to_pylist()]
        if self._broken is not None:
            rows = [replace(row, fatal=row.fatal or self._broken) for row in rows]
        else:
            with ThreadPoolExecutor(min(len(rows), self._session.in_flight)) as threads:
                rows = list(threads.map(self._advance, rows))
        return arrow.table({"row": arrow.array([pickle.dumps(row) for row in rows], arrow.large_binary())})

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
