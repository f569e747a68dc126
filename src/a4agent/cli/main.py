"""`a4`: the commands and their modules. Only the one that is called is imported, so that help is instant."""

from __future__ import annotations

import importlib
import io
import sys
from typing import Annotated, Any

import typer

from a4agent import __version__
from a4agent.cli import common
from a4agent.errors import A4Error, UserError

CommandLineError: Any = typer.BadParameter.__mro__[2]
"""click's base class; some versions of typer carry their own copy of click."""

COMMANDS = {
    "predict": ("predict", "Find the part to act on, in images, folders or globs."),
    "track": ("track", "Follow the part to act on through a video."),
    "annotate": ("track", "Label every frame of a video or folder."),
    "bench": ("bench", "Run a profile on a benchmark and score it."),
    "score": ("score", "Score masks that another system wrote."),
    "report": ("runs", "Write a run as one HTML file."),
    "compare": ("runs", "Compare runs on the samples they share."),
    "tables": ("runs", "Print the paper's tables with your runs in them."),
    "calibrate": ("runs", "Fit a verifier's confidence to scored runs."),
    "data": ("data", "Check benchmark data, or make some."),
    "models": ("models", "List, fetch and verify the models of a profile."),
    "profiles": ("profiles", "List the profiles and what each needs."),
    "cache": ("cache", "Show or clear the answers kept on disk."),
    "doctor": ("doctor", "Say what works on this machine, and how to get the rest."),
    "serve": ("serve", "Serve affordances over HTTP."),
    "app": ("serve", "Open the web page."),
    "mcp": ("serve", "Offer the agent to language agents as tools (MCP)."),
}
"""Command -> its module in `a4agent.cli`, and its line in the help."""


def build(name: str | None) -> typer.Typer:
    """The application with the command `name` loaded, and a line of help for each of the others."""
    app = typer.Typer(
        name="a4",
        help="Which part of the thing in this picture do I act on?",
        no_args_is_help=True,
        add_completion=False,
        rich_markup_mode="rich",
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(_root)
    for command, (module, line) in COMMANDS.items():
        if command != name:
            app.command(command, help=line)(_placeholder)
            continue
        loaded = importlib.import_module(f"a4agent.cli.{module}")
        found: Any = getattr(loaded, "app", None)
        if isinstance(found, typer.Typer):
            app.add_typer(found, name=command, help=line)
        else:
            app.command(command)(getattr(loaded, command))
    return app


def _version(wanted: bool) -> None:
    if wanted:
        print(f"a4agent {__version__}")
        raise typer.Exit


def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    return None


def _placeholder() -> None:
    return None


def main(arguments: list[str] | None = None) -> None:
    """Run `a4`. Exit codes: 0 ok, 1 some samples failed, 2 usage, 130 interrupted."""
    arguments = sys.argv[1:] if arguments is None else arguments
    for stream in (sys.stdout, sys.stderr):  # do not stop at a name or an answer that the terminal cannot show
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    name = next((argument for argument in arguments if not argument.startswith("-")), None)
    try:
        code = build(name)(args=arguments, prog_name="a4", standalone_mode=False)
        if code == common.INTERRUPTED:
            common.say("interrupted")
        sys.exit(code if isinstance(code, int) else common.OK)
    except CommandLineError as error:
        sys.exit(_usage(error))
    except A4Error as error:
        sys.exit(common.fail(error))
    except (KeyboardInterrupt, typer.Abort):
        common.say("interrupted")
        sys.exit(common.INTERRUPTED)
    except BrokenPipeError:
        sys.stderr.close()
        sys.exit(common.SOME_FAILED)


def _usage(error: Any) -> int:
    """Print a mistake in the command line in one line; returns the exit code."""
    if type(error).__name__ == "NoArgsIsHelpError":  # its message is the help
        error.show(file=sys.stdout)
        return common.USAGE
    text = error.format_message().strip().rstrip(".")
    command = error.ctx.command_path if getattr(error, "ctx", None) else "a4"
    end = " See" if text.endswith("?") else "; see"
    return common.fail(UserError(f"{text[:1].lower()}{text[1:]}{end} {command} --help"))


if __name__ == "__main__":
    main()
