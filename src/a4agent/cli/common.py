"""What the commands share: settings from options, messages on stderr, exit codes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from a4agent.errors import ConfigError, UserError

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn

    from a4agent.agent import A4Agent
    from a4agent.config import Settings

OK, SOME_FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130

messages = Console(stderr=True, highlight=False, emoji=False)
"""Where everything goes that is not the result."""

ProfileOption = Annotated[
    str | None, typer.Option("--profile", "-p", help="A profile's name (see `a4 profiles`) or a TOML file.")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="Replace a setting: --set spotter.segmenter=sam2:tiny"),
]


def settings(profile: str | None, sets: list[str] | None = None, **extra: Any) -> Settings:
    """The merged settings of a command; `extra` are flags by dotted name with "__" for ".", None left out.

    Raises:
        ConfigError: a `--set` that is not NAME=VALUE, or whatever the settings do not allow.
    """
    from a4agent.config import load_settings, parse_value

    overrides: dict[str, Any] = {}
    for text in sets or []:
        name, equals, value = text.partition("=")
        if not equals or not name.strip():
            raise ConfigError(f"--set takes NAME=VALUE (such as spotter.segmenter=sam2:tiny), not {text!r}")
        overrides[name.strip()] = parse_value(value.strip())
    overrides.update({name.replace("__", "."): value for name, value in extra.items() if value is not None})
    return load_settings(profile, overrides)


def build_agent(settings: Settings) -> A4Agent:
    """The agent of a command, after making sure that every model it needs is here or can be fetched.

    Raises:
        ModelFilesError: a model is not here and the hub cannot be reached; the message names all of them.
        ConfigError: an expert that cannot be built.
    """
    from a4agent import requirements
    from a4agent.agent import A4Agent

    for need in requirements.check(settings.expert_specs()):
        say(f"fetching {need.reference}: {need.terms}")
    return A4Agent.from_settings(settings)


def bar(*columns: ProgressColumn, hidden: bool = False) -> Progress:
    """A progress bar on stderr that goes when it is done; `hidden`, or where there is no terminal, it shows nothing."""
    from rich.progress import Progress

    return Progress(*columns, console=messages, transient=True, disable=hidden or not messages.is_terminal)


def say(text: str) -> None:
    """A line on stderr, as it is: names may hold what rich takes for markup."""
    messages.print(text, markup=False, soft_wrap=True)


def fail(error: BaseException) -> int:
    """Say what went wrong, without a traceback; returns the exit code."""
    messages.print(f"[bold red]error:[/] {_escaped(str(error))}", soft_wrap=True)
    return USAGE if isinstance(error, UserError) else SOME_FAILED


def warn(message: str) -> None:
    """One line of warning."""
    messages.print(f"[bold yellow]warning:[/] {_escaped(message)}", soft_wrap=True)


def _escaped(text: str) -> str:
    from rich.markup import escape

    return escape(text)
