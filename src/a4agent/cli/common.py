"""What the commands share: options, settings and benchmarks from them, messages on stderr, exit codes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from a4agent.errors import ConfigError, DataError, UserError

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn

    from a4agent.agent import A4Agent
    from a4agent.benchmarks.base import Benchmark
    from a4agent.config import Settings

OK, SOME_FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130

messages = Console(stderr=True, highlight=False, emoji=False)
"""Everything but the result goes here."""

ProfileOption = Annotated[
    str | None, typer.Option("--profile", "-p", help="A profile's name (see `a4 profiles`) or a TOML file.")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="Replace a setting: --set spotter.segmenter=sam2:tiny"),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print as JSON.")]
CacheOption = Annotated[str | None, typer.Option(help="off, read or write: reuse answers kept on disk.")]
CostOption = Annotated[float | None, typer.Option(help="Stop at this many US dollars.")]
ProtocolOption = Annotated[str | None, typer.Option(help="strict, affordance-r1, affordance-r1-umd or ragnet.")]
NameArgument = Annotated[str, typer.Argument(metavar="BENCHMARK", help="umd, reasonaff, ragnet-3doi, folder, ...")]
DataOption = Annotated[Path, typer.Option("--data", help="The folder of the dataset.")]
OptionsOption = Annotated[
    list[str] | None,
    typer.Option("--option", metavar="NAME=VALUE", help="An option of the benchmark: --option rule=affordance-r1"),
]


def settings(profile: str | None, sets: list[str] | None = None, **extra: Any) -> Settings:
    """The merged settings of a command; `extra` are flags by dotted name with "__" for ".", None left out.

    Raises:
        ConfigError: a `--set` that is not NAME=VALUE, or an invalid setting.
    """
    from a4agent.config import load_settings

    overrides = _pairs("--set", sets, "spotter.segmenter=sam2:tiny")
    overrides.update({name.replace("__", "."): value for name, value in extra.items() if value is not None})
    return load_settings(profile, overrides)


def opened(name: str, path: Path | None, options: list[str] | None = None, *, empty: bool = True) -> Benchmark:
    """The benchmark that the options name; `empty` allows one without samples.

    Raises:
        ConfigError: an `--option` that is not NAME=VALUE, or that the benchmark does not have.
        DataError: the data at `path` is not this benchmark, or has no samples.
    """
    from a4agent.benchmarks.registry import load

    benchmark = load(name, path, _pairs("--option", options, "instruction=1"))
    if not len(benchmark) and not empty:
        raise DataError(
            f"the {benchmark.name} data in {str(benchmark.root)!r} has no samples; `a4 data check` says what is there"
        )
    return benchmark


def _pairs(option: str, texts: Sequence[str] | None, example: str) -> dict[str, Any]:
    """The values of a repeated NAME=VALUE option."""
    from a4agent.config import parse_value

    found: dict[str, Any] = {}
    for text in texts or ():
        name, equals, value = text.partition("=")
        if not equals or not name.strip():
            raise ConfigError(f"{option} takes NAME=VALUE (such as {example}), not {text!r}")
        found[name.strip()] = parse_value(value.strip())
    return found


def build_agent(settings: Settings) -> A4Agent:
    """The agent of a command, once every model it needs is on this disk or can be fetched.

    Raises:
        ModelFilesError: a model is missing and the hub cannot be reached; the message names all of them.
        ConfigError: an expert cannot be built.
    """
    from a4agent import requirements
    from a4agent.agent import A4Agent

    for need in requirements.check(settings.expert_specs()):
        say(f"fetching {need.reference}: {need.terms}")
    return A4Agent.from_settings(settings)


def bar(*columns: ProgressColumn, hidden: bool = False, expand: bool = False) -> Progress:
    """A progress bar on stderr that disappears when it is done; `hidden`, or without a terminal, it shows nothing."""
    from rich.progress import Progress

    disable = hidden or not messages.is_terminal
    return Progress(*columns, console=messages, transient=True, disable=disable, expand=expand)


def output() -> Console:
    """The console for results on stdout: no guessed colours, no emoji, no wrapping."""
    return Console(highlight=False, emoji=False, soft_wrap=True)


def print_json(value: Any) -> None:
    """A result as JSON on stdout."""
    print(json.dumps(value, indent=1))


def say(text: str) -> None:
    """A line on stderr, without rich's markup, which names may look like."""
    messages.print(text, markup=False, soft_wrap=True)


def fail(error: BaseException) -> int:
    """Print an error in one line, without a traceback; returns the exit code."""
    messages.print(f"[bold red]error:[/] {_escaped(str(error))}", soft_wrap=True)
    return USAGE if isinstance(error, UserError) else SOME_FAILED


def warn(message: str) -> None:
    """Print a warning in one line."""
    messages.print(f"[bold yellow]warning:[/] {_escaped(message)}", soft_wrap=True)


def _escaped(text: str) -> str:
    from rich.markup import escape

    return escape(text)
