"""`a4 profiles`: which profiles there are, what plays which role, and what each needs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from a4agent import requirements
from a4agent.cli import common
from a4agent.config import ProfileInfo, Settings, load_profile, profile_names
from a4agent.requirements import Need, check_profile


def profiles(
    name: Annotated[str | None, typer.Argument(help="Show one profile whole.")] = None,
    as_json: common.JsonOption = False,
) -> None:
    """List the profiles and what each needs."""
    names = [name] if name else profile_names()
    found = {known: load_profile(known) for known in names}
    if as_json:
        common.print_json([_as_dict(known, settings) for known, settings in found.items()])
    elif name:
        _show_one(name, found[name])
    else:
        _show_all(found)


def _as_dict(name: str, settings: Settings) -> dict[str, object]:
    checkpoints = requirements.needs(settings.expert_specs())
    return {
        "name": name,
        **settings.profile.model_dump(),
        "extras": requirements.extras_of(settings.expert_specs()),
        "licences": licences(settings.profile, checkpoints),
        "downloads": downloads(checkpoints),
        "experts": {role: spec.expert for role, spec in settings.expert_specs().items()},
        "missing": [{"what": missing.what, "fix": missing.fix} for missing in check_profile(name)],
    }


def licences(profile: ProfileInfo, checkpoints: Sequence[Need]) -> list[str]:
    """The licence of each checkpoint, and what the profile says of its other models."""
    listed = [
        f"{one.name}: {one.info.licence}{'' if one.info.commercial else ', non-commercial'}" for one in checkpoints
    ]
    return [*profile.licences, *listed]


def downloads(checkpoints: Sequence[Need]) -> list[str]:
    """Checkpoints with their sizes; see `a4 models list` for more."""
    return [f"{need.name} ({need.info.gigabytes:g} GB)" if need.info.gigabytes else need.name for need in checkpoints]


def _show_all(found: dict[str, Settings]) -> None:
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("")
    table.add_column("profile", no_wrap=True)
    table.add_column("what", ratio=3)
    table.add_column("memory, about", ratio=2, overflow="fold")
    runs_here = {name: not check_profile(name) for name in found}
    for name in sorted(found, key=lambda name: not runs_here[name]):
        info, here = found[name].profile, runs_here[name]
        memory = re.split(r"[;(]", info.memory)[0].strip().removeprefix("about ")  # its own page has the rest
        mark, bold = ("[green]●[/]", f"[bold]{name}[/]") if here else ("[dim]○[/]", name)
        table.add_row(mark, bold, info.summary, memory)
    console = Console(highlight=False, emoji=False)
    console.print(table)
    console.print("[dim]● runs here   ○ needs something first: `a4 profiles NAME` says what[/]")


def _show_one(name: str, settings: Settings) -> None:
    console = common.output()
    info, checkpoints = settings.profile, requirements.needs(settings.expert_specs())
    console.print(f"[bold]{name}[/]  {escape(info.summary)}")
    for role, spec in settings.expert_specs().items():
        own = ", ".join(f"{key} = {value}" for key, value in spec.settings.items())
        console.print(f"  {role:18} {escape(spec.expert)}{f'  [dim]({escape(own)})[/]' if own else ''}")
    for title, lines in (
        ("memory", [info.memory]),
        ("downloads", downloads(checkpoints)),
        ("licences", licences(info, checkpoints)),
        ("extras", requirements.extras_of(settings.expert_specs())),
        ("notes", [info.notes]),
    ):
        if any(lines):
            console.print(f"  [bold]{title:9}[/] {escape('; '.join(lines))}")
    missing = check_profile(name)
    console.print("  [green]runs here[/]" if not missing else "  [yellow]missing here:[/]")
    for one in missing:
        console.print(f"    {escape(one.what)}\n      [cyan]{escape(one.fix)}[/]")
