"""Options of the commands that open a benchmark: its name, where it lies, and its own options."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from a4agent.errors import ConfigError, DataError

if TYPE_CHECKING:
    from a4agent.benchmarks.base import Benchmark

NameArgument = Annotated[str, typer.Argument(metavar="BENCHMARK", help="umd, reasonaff, ragnet-3doi, folder, ...")]
DataOption = Annotated[Path, typer.Option("--data", help="The folder of the dataset.")]
OptionsOption = Annotated[
    list[str] | None,
    typer.Option("--option", metavar="NAME=VALUE", help="An option of the benchmark: --option rule=affordance-r1"),
]


def opened(name: str, path: Path | None, options: list[str] | None = None) -> Benchmark:
    """The benchmark that the options name.

    Raises:
        ConfigError: an `--option` that is not NAME=VALUE, or that the benchmark does not have.
        DataError: what lies at `path` is not this benchmark.
    """
    from a4agent.benchmarks.registry import load
    from a4agent.config import parse_value

    given: dict[str, Any] = {}
    for text in options or []:
        option, equals, value = text.partition("=")
        if not equals or not option.strip():
            raise ConfigError(f"--option takes NAME=VALUE (such as instruction=1), not {text!r}")
        given[option.strip()] = parse_value(value.strip())
    return load(name, path, given)


def with_samples(benchmark: Benchmark) -> Benchmark:
    """The same benchmark, if there is anything to ask.

    Raises:
        DataError: there is not.
    """
    if not len(benchmark):
        raise DataError(
            f"the {benchmark.name} data in {str(benchmark.root)!r} has no samples; `a4 data check` says what is there"
        )
    return benchmark
