"""The experts on many machines: a pool of Ray actors for each stage, and everything else as on one machine.

    [ray.dreamer]                    # in a profile: what the pool of a stage gets
    replicas = 12                    # actors, each with its own experts (default 1)
    num_gpus = 1                     # per actor (default 0)
    num_cpus = 2                     # per actor (default 0.5)
    batch = 8                        # calls an actor takes at once, if the expert allows them (default 16)

The agent runs in this process, behind the local engine with its cache, retries, breakers and budget. Each of its
experts is an `ActorExpert`, which sends batches of requests to an actor that holds the real one. Nodes need the same
packages, keys and model files. RAY_ADDRESS names the cluster; without it, Ray is started here.
"""

from __future__ import annotations

import itertools
import logging
import os
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from PIL import Image

from a4agent import engine
from a4agent.agent import A4Agent
from a4agent.config import STAGES, RayPool, Settings
from a4agent.engine import Stats
from a4agent.errors import A4Error, ConfigError, ProviderError, ProviderUnavailable, require
from a4agent.experts import registry
from a4agent.protocols import VERBS, Charges, Request, Role, ask
from a4agent.types import Affordance, Given, Query

POLL = 0.5
"""Seconds between two looks at whether further actors have started."""


def run(
    settings: Settings,
    queries: Iterable[Query],
    *,
    ordered: bool = False,
    given: Callable[[Query], Given | None] | None = None,
    stats: Stats | None = None,
) -> Iterator[tuple[Query, Affordance]]:
    """`engine.run` for the agent of these settings, with its experts in Ray actors.

    Raises:
        MissingExtraError: ray is not installed.
        ConfigError: the cluster is unreachable or too small.
        UserError, ProviderError, BudgetExceeded: as `engine.run`.
    """
    remaining = iter(queries)
    first = next(remaining, None)
    if first is None:
        return
    with agent_on_ray(settings) as agent:
        rest = itertools.chain([first], remaining)
        yield from engine.run(agent, rest, settings=settings.engine, ordered=ordered, given=given, stats=stats)


@contextmanager
def agent_on_ray(settings: Settings) -> Generator[A4Agent]:
    """The agent of these settings with its experts in Ray actors, which end with the block.

    Raises:
        MissingExtraError: ray is not installed.
        ConfigError: the cluster is unreachable or too small.
        UserError: an expert cannot be built on its node.
    """
    ray: Any = require("ray", extra="ray")
    specs = settings.expert_specs()
    pools: dict[str, RayPool] = {
        stage: getattr(settings.ray, stage) for stage in STAGES if any(name.startswith(f"{stage}.") for name in specs)
    }
    with _connected(ray):
        send_pictures_as_arrays()
        _check_size(ray.cluster_resources(), pools)
        actors = {stage: _start_actors(ray, settings, stage, pool) for stage, pool in pools.items()}
        try:
            experts: dict[str, Any] = {}
            for stage, pool in pools.items():
                experts |= _remote_experts(ray, actors[stage], pool.batch)
            yield A4Agent.from_settings(settings, experts)
        finally:
            for actor in itertools.chain.from_iterable(actors.values()):
                with suppress(Exception):  # Ray may be gone already
                    ray.kill(actor)


class ActorExpert:
    """Stands in for an expert held by each actor of a pool; asks the one with the fewest calls in flight."""

    def __init__(self, name: str, about: ExpertFacts, actors: Actors, batch: int) -> None:
        self.id = about.id
        self.max_batch = about.max_batch
        self._name = name
        self._fingerprint = about.fingerprint
        self._actors = actors
        self._calls_each = min(max(1, about.concurrency), batch)
        self.concurrency = self._calls_each * actors.size
        setattr(self, VERBS[about.role], self._ask)
        if about.price_known is not None:
            self.price_known = about.price_known

    def fingerprint(self) -> Mapping[str, Any]:
        return self._fingerprint

    def close(self) -> None:
        """The actors end with the run."""

    def _ask(self, requests: Sequence[Request]) -> list[Any]:
        with self._actors.least_busy(self._name, self._calls_each) as actor:
            found = self._actors.result(actor.ask.remote(self._name, list(requests)), self.id)
        if isinstance(found, A4Error):
            raise found
        return found


class Actors:
    """The actors of one stage: those that have started, and the calls in flight at each, by expert."""

    def __init__(self, ray: Any, actors: Sequence[Any], starting: Mapping[Any, int]) -> None:
        self._ray = ray
        self._actors = actors
        self._starting = dict(starting)
        self._in_flight: dict[tuple[str, int], int] = {}
        self._changed = threading.Condition()

    @property
    def size(self) -> int:
        return len(self._actors)

    @contextmanager
    def least_busy(self, name: str, limit: int) -> Generator[Any]:
        """Hold one of at most `limit` places for an expert at a started actor, waiting for one to be free."""
        with self._changed:
            while (found := self._free(name, limit)) is None:
                self._changed.wait(POLL)
            self._in_flight[name, found] = self._in_flight.get((name, found), 0) + 1
        try:
            yield self._actors[found]
        finally:
            with self._changed:
                self._in_flight[name, found] -= 1
                self._changed.notify()

    def result(self, reference: Any, expert: str) -> Any:
        """What an actor returned.

        Raises:
            ProviderUnavailable: the actor or its node died; Ray starts another one in its place.
        """
        try:
            return self._ray.get(reference)
        except self._ray.exceptions.RayError as error:
            raise ProviderUnavailable(f"the actor of {expert} failed: {str(error).splitlines()[0]}") from error

    def _free(self, name: str, limit: int) -> int | None:
        if self._starting:
            started, _ = self._ray.wait(list(self._starting), num_returns=len(self._starting), timeout=0)
            for reference in started:
                del self._starting[reference]
        waiting = set(self._starting.values())
        free = {k: self._in_flight.get((name, k), 0) for k in range(self.size) if k not in waiting}
        best = min(free, key=lambda k: free[k], default=None)
        return best if best is not None and free[best] < limit else None


@dataclass(frozen=True)
class ExpertFacts:
    """What the driver needs to know of an actor's expert."""

    role: Role
    id: str
    max_batch: int
    concurrency: int
    fingerprint: Mapping[str, Any]
    price_known: bool | None


class StageActor:
    """Runs on a node: the experts of one stage. Errors are returned, which keeps their class."""

    def __init__(self, settings: Settings, stage: str) -> None:
        specs = settings.expert_specs()
        send_pictures_as_arrays()
        self._broken: A4Error | None = None
        self._experts: dict[str, Any] = {}
        try:
            self._experts = registry.build({name: specs[name] for name in specs if name.startswith(f"{stage}.")})
        except A4Error as error:
            self._broken = error

    def about(self) -> dict[str, ExpertFacts] | A4Error:
        """The facts of each expert, or the error that kept them from being built."""
        return self._broken or {
            name: ExpertFacts(
                cast(Role, name.rpartition(".")[2]),
                expert.id,
                expert.max_batch,
                expert.concurrency,
                dict(expert.fingerprint()),
                expert.price_known if isinstance(expert, Charges) else None,
            )
            for name, expert in self._experts.items()
        }

    def ask(self, name: str, requests: list[Request]) -> list[Any] | A4Error:
        """The expert's answers, or the error that concerns all of these requests."""
        if self._broken is not None:
            return self._broken
        try:
            return ask(self._experts[name], requests)
        except A4Error as error:
            return error
        except Exception as error:
            return ProviderError(f"{self._experts[name].id} failed: {error!r}")


def _start_actors(ray: Any, settings: Settings, stage: str, pool: RayPool) -> list[Any]:
    roles = sum(name.startswith(f"{stage}.") for name in settings.expert_specs())
    actor = ray.remote(
        num_cpus=pool.num_cpus,
        num_gpus=pool.num_gpus,
        max_restarts=-1,
        max_concurrency=pool.batch * roles,
    )(StageActor)
    return [actor.remote(settings, stage) for _ in range(pool.replicas)]


def _remote_experts(ray: Any, handles: list[Any], batch: int) -> dict[str, ActorExpert]:
    """The experts of a stage, once its first actor has started."""
    starting = {handle.about.remote(): number for number, handle in enumerate(handles)}
    started, _ = ray.wait(list(starting), num_returns=1)
    actors = Actors(ray, handles, starting)
    reported = actors.result(started[0], "a stage")
    if isinstance(reported, A4Error):
        raise reported
    return {name: ActorExpert(name, about, actors, batch) for name, about in reported.items()}


def send_pictures_as_arrays() -> None:
    """Let this process hand pictures to Ray as arrays, which travel through shared memory: five times as fast."""

    def to_array(picture: Image.Image) -> np.ndarray:
        return np.asarray(picture if picture.mode in ("L", "RGB", "RGBA") else picture.convert("RGB"))

    util: Any = require("ray.util", extra="ray")
    util.register_serializer(Image.Image, serializer=to_array, deserializer=Image.fromarray)


@contextmanager
def _connected(ray: Any) -> Generator[None]:
    """Use the Ray that is running, or start one and shut it down again."""
    started_here = not ray.is_initialized()
    if started_here:
        try:
            ray.init(include_dashboard=False, logging_level=logging.ERROR)
        except (ConnectionError, ValueError, RuntimeError) as error:
            where = os.environ.get("RAY_ADDRESS")
            hint = f"is a cluster running at RAY_ADDRESS = {where!r}?" if where else "try `ray start --head`"
            raise ConfigError(f"cannot reach Ray: {error}; {hint}") from error
    try:
        yield
    finally:
        if started_here:
            ray.shutdown()


def _check_size(found: Mapping[str, float], pools: Mapping[str, RayPool]) -> None:
    """Raise ConfigError if there is no room for an actor of each stage, since Ray would wait for a node forever."""
    for resource, key in (("CPU", "num_cpus"), ("GPU", "num_gpus")):
        needed, there = sum(getattr(pool, key) for pool in pools.values()), found.get(resource, 0.0)
        if needed > there:
            settings = ", ".join(f"ray.{stage}.{key}" for stage in pools)
            raise ConfigError(
                f"an actor for each of {', '.join(pools)} takes {needed:g} {resource}s, and Ray has {there:g};"
                f" add nodes, or lower {settings}"
            )
