"""`a4 doctor`: what works on this machine, what is missing, and the command that gets it."""

from __future__ import annotations

import os
import platform
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from rich.markup import escape

from a4agent import __version__
from a4agent.benchmarks import registry
from a4agent.cli import common
from a4agent.config import ExpertSettings, load_profile, load_settings, profile_names
from a4agent.errors import A4Error
from a4agent.experts import registry as experts
from a4agent.protocols import Role
from a4agent.requirements import EXTRAS, check_profile, missing_modules


def doctor(as_json: common.JsonOption = False) -> None:
    """Say what works on this machine, and how to get the rest."""
    report = examine()
    if as_json:
        common.print_json(report)
    else:
        _show(report)


def examine() -> dict[str, Any]:
    """Versions, memory, accelerators, extras, keys and profiles, JSON-safe."""
    return {
        "a4agent": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cores": os.cpu_count(),
        "memory_gb": _memory_gb(),
        "accelerators": _accelerators(),
        "free_disk_gb": _free_disk_gb(),
        "hub_offline": os.environ.get("HF_HUB_OFFLINE", "") not in ("", "0"),
        "keys": {name: bool(os.environ.get(name, "").strip()) for name in ("OPENAI_API_KEY", "HF_TOKEN")},
        "extras": {
            extra: {
                "missing": missing_modules(extra),
                "size": EXTRAS[extra].size,
                "fix": f"pip install 'a4agent[{extra}]'",
            }
            for extra in EXTRAS
        },
        "simulator": registry.missing("sim"),
        "settings": _settings(),
        "retiring": _retiring(),
        "profiles": {
            name: [{"what": missing.what, "fix": missing.fix} for missing in check_profile(name)]
            for name in profile_names()
        },
        "profiles_until": {
            name: models for name in profile_names() if (models := _announced(load_profile(name).expert_specs()))
        },
    }


def _settings() -> str:
    """What is wrong with the variables `A4_*` and `a4.toml` here, which every command reads; "" if they are valid."""
    try:
        load_settings()
    except A4Error as error:
        return str(error)
    return ""


def _retiring() -> dict[str, str]:
    """The models of the current settings that are about to be switched off, with the day. Asks their servers."""
    found: dict[str, str] = {}
    try:
        specs = load_settings().expert_specs()
    except A4Error:
        return found
    for role, spec in specs.items():
        try:
            expert: Any = experts.create(spec.expert, cast(Role, role.rpartition(".")[2]), spec.settings)
        except Exception:  # the lines of its profile name what is missing
            found |= _announced({role: spec})
            continue
        date = expert.shutdown_date() if hasattr(expert, "shutdown_date") else ""
        if date:
            found[expert.id] = date
        expert.close()
    return found


def _announced(specs: Mapping[str, ExpertSettings]) -> dict[str, str]:
    """The models whose vendors have announced a last day, as far as this package knows. Sends no request."""
    dates = {spec.expert: experts.last_day(spec.expert, spec.settings) for spec in specs.values()}
    return {name: date for name, date in dates.items() if date}


def _free_disk_gb() -> float | None:
    """On the disk of the home folder, where models go unless HF_HOME moves them; None without a home."""
    try:
        return round(shutil.disk_usage(Path.home()).free / 1e9, 1)
    except (OSError, RuntimeError):
        return None


def _memory_gb() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1)
    except (AttributeError, ValueError, OSError):
        return None


def _accelerators() -> list[str]:
    """The GPUs that torch sees; asks torch only if it is installed."""
    if "torch" in missing_modules("local"):
        return []
    try:
        import torch
    except (ImportError, OSError):  # OSError: a library that torch needs cannot be loaded
        return []
    if torch.cuda.is_available():
        return [
            f"{torch.cuda.get_device_name(i)}, {torch.cuda.get_device_properties(i).total_memory / 1e9:.0f} GB"
            for i in range(torch.cuda.device_count())
        ]
    return ["Apple GPU (mps)"] if torch.backends.mps.is_available() else []


def _show(report: dict[str, Any]) -> None:
    console = common.output()
    good, bad = "[green]✓[/]", "[yellow]–[/]"
    console.print(f"a4agent {report['a4agent']}, Python {report['python']}, {escape(report['platform'])}")
    accelerators = ", ".join(report["accelerators"]) or "no GPU (the profiles `offline` and `api` need none)"
    memory = f"{report['memory_gb']} GB memory" if report["memory_gb"] else "memory unknown"
    disk = f"{report['free_disk_gb']} GB disk free" if report["free_disk_gb"] is not None else "disk unknown"
    console.print(f"{report['cores']} cores, {memory}, {disk}, {accelerators}")
    if report["settings"]:
        console.print(f"\n[bold]Settings[/]\n  {bad} {escape(report['settings'])}")
    if report["retiring"]:
        console.print("\n[bold]Models about to be switched off[/]")
        for model, date in report["retiring"].items():
            console.print(f"  {bad} {escape(model)} on {escape(date)}; choose another with --set")
    console.print("\n[bold]Extras[/]")
    width = max(map(len, [*report["extras"], *report["profiles"]]))
    wide = max(len(state["fix"]) for state in report["extras"].values())
    for extra, state in report["extras"].items():
        if not state["missing"]:
            console.print(f"  {good} {extra}")
        else:
            fix = f"{state['fix']:{wide}}"
            console.print(f"  {bad} {extra:{width}} [cyan]{escape(fix)}[/]  [dim]{state['size']}[/]")
    console.print("\n[bold]Keys[/]")
    for name, there in report["keys"].items():
        console.print(f"  {good} {name}" if there else f"  {bad} {name:{width}} [cyan]export {name}=...[/]")
    console.print("\n[bold]Simulator benchmark[/]")
    lacking = report["simulator"]
    console.print(f"  {bad} {escape(lacking)}" if lacking else f"  {good} assets and renderer")
    console.print("\n[bold]Profiles[/]")
    counts = {name: _in_short(missing) for name, missing in report["profiles"].items() if missing}
    long = max(map(len, counts.values()), default=0)
    for name, missing in sorted(report["profiles"].items(), key=lambda row: bool(row[1])):
        ends = report["profiles_until"].get(name, {})
        until = "".join(f"  {escape(model)} ends {date}" for model, date in ends.items())
        if not missing:
            console.print(f"  {good} {name}{until}")
            continue
        console.print(
            f"  {bad} {name:{width}} {counts[name]:{long}}  [cyan]a4 profiles {name:{width if until else 0}}[/]{until}"
        )


def _in_short(missing: list[dict[str, str]]) -> str:
    """ "3 models, 1 key to get": what is missing, counted by the kind of command that gets it."""
    kinds, plurals = {"pip": "library", "a4 models pull": "model", "export": "key"}, {"library": "libraries"}
    fixes = {one["fix"] for one in missing}
    counts = {word: sum(fix.startswith(start) for fix in fixes) for start, word in kinds.items()}
    counts["thing"] = len(fixes) - sum(counts.values())
    counted = [f"{n} {word}" if n == 1 else f"{n} {plurals.get(word, f'{word}s')}" for word, n in counts.items() if n]
    return f"{', '.join(counted)} to get"
