"""From a benchmark's name and a path to the benchmark.

A reader is an entry point of the group `a4agent.benchmarks` that names a function:

    [project.entry-points."a4agent.benchmarks"]
    umd = "a4agent.benchmarks.umd:create"

    def create(path: str | Path, *, rule: str = "a4") -> Benchmark

Its keyword-only parameters are the benchmark's options. Built-in readers register like a stranger's,
and nothing is imported before it is asked for.
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Mapping
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, cast

from a4agent.benchmarks.base import Benchmark
from a4agent.errors import A4Error, ConfigError, UnknownNameError

GROUP = "a4agent.benchmarks"
Factory = Callable[..., Benchmark]

_added: dict[str, Factory] = {}


def register(name: str, factory: Factory) -> None:
    """Add a benchmark for this process, without packaging. Replaces one of the same name."""
    _added[name] = factory


@lru_cache(maxsize=1)
def _entry_points() -> Mapping[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=GROUP)}


def names() -> list[str]:
    """The names of all registered benchmarks."""
    return sorted({*_entry_points(), *_added})


def factory_of(name: str) -> Factory:
    """The function that opens a benchmark.

    Raises:
        UnknownNameError: nobody registered it; the message suggests the nearest name.
        ConfigError: it is registered, but its module cannot be loaded.
    """
    if name in _added:
        return _added[name]
    point = _entry_points().get(name)
    if point is None:
        raise UnknownNameError.of("benchmark", name, names())
    try:
        return cast(Factory, point.load())
    except A4Error:
        raise
    except Exception as error:
        message = f"the benchmark {name!r} ({point.value}) cannot be loaded: {error!r}"
        warnings.warn(message, stacklevel=2)
        raise ConfigError(message) from error


def options_of(factory: Factory) -> dict[str, Any]:
    """Names and defaults of a benchmark's options."""
    parameters = inspect.signature(factory).parameters.values()
    return {p.name: p.default for p in parameters if p.kind is inspect.Parameter.KEYWORD_ONLY}


def load(name: str, path: str | Path | None, options: Mapping[str, Any] | None = None) -> Benchmark:
    """Open the benchmark `name` at `path`; without one, if it has data of its own.

    Raises:
        UnknownNameError: no such benchmark, or it has no such option.
        ConfigError: it needs a path.
        DataError: what lies at `path` is not this benchmark.
    """
    factory = factory_of(name)
    known = options_of(factory)
    for option in options or {}:
        if option not in known:
            raise UnknownNameError.of(f"option of the benchmark {name!r}:", option, known)
    if path is None:
        first = next(iter(inspect.signature(factory).parameters.values()))
        if first.default is inspect.Parameter.empty:
            raise ConfigError(f"where is the data of {name!r}? give its folder with --data PATH")
    return factory(path, **(options or {}))
