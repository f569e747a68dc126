"""Opens benchmarks by name.

A reader is an entry point of the group `a4agent.benchmarks` that names a function:

    [project.entry-points."a4agent.benchmarks"]
    umd = "a4agent.benchmarks.umd:create"

    def create(path: str | Path, *, rule: str = "a4") -> Benchmark

Its keyword-only parameters are the benchmark's options. Built-in readers register in the same way, and each is
imported when it is first used.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from a4agent.benchmarks.base import Benchmark
from a4agent.errors import ConfigError, UnknownNameError
from a4agent.plugins import Plugins, keywords_of

Factory = Callable[..., Benchmark]

plugins = Plugins("a4agent.benchmarks", "benchmark")
register, names = plugins.register, plugins.names
factory_of: Callable[[str], Factory] = plugins.find
"""The function that opens the benchmark of a name; see `Plugins.find` for its errors."""


def maker_of(name: str) -> Callable[..., Path]:
    """The function that makes this benchmark's data: `make` in its reader's module.

    Raises:
        UnknownNameError: no such benchmark.
        ConfigError: its data has to be downloaded.
    """
    module = sys.modules[factory_of(name).__module__]
    if not hasattr(module, "make"):
        raise ConfigError(f"the data of {name!r} has to be downloaded; `a4 data list` shows the benchmarks")
    return module.make


def missing(name: str) -> str:
    """What is missing here to make a benchmark's data, and the command that fixes it; "" if nothing is."""
    try:
        maker_of(name)
    except ConfigError as error:
        return str(error)
    return getattr(sys.modules[factory_of(name).__module__], "missing", str)()


def options_of(factory: Factory) -> dict[str, Any]:
    """Names and defaults of a benchmark's options."""
    return keywords_of(factory) or {}


def load(name: str, path: str | Path | None, options: Mapping[str, Any] | None = None) -> Benchmark:
    """Open the benchmark `name` at `path`, which may be None if it has data of its own.

    Raises:
        UnknownNameError: no such benchmark, or it has no such option.
        ConfigError: it needs a path.
        DataError: the data at `path` is not this benchmark.
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
