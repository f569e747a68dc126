"""`a4 predict IMAGE... "instruction"`: images in, one folder of results for each out."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
from rich.text import Text

from a4agent import engine
from a4agent.acting.lifting import Intrinsics, read_depth
from a4agent.acting.plan import ActionPlan, draw_plan, plan_action
from a4agent.cli import common
from a4agent.cli.common import CacheOption, CostOption, ProfileOption, SetOption, say
from a4agent.cli.sources import Source, find_sources, free_folder, name_results, split_arguments
from a4agent.config import Settings
from a4agent.errors import InputError
from a4agent.files import replace_file
from a4agent.imaging.save import make_folder
from a4agent.types import Affordance, Query, Trace


def predict(
    arguments: Annotated[
        list[str],
        typer.Argument(
            metavar='IMAGE... "INSTRUCTION"',
            help="Image files, folders, globs, URLs or - (standard input); then what to do, in quotes.",
        ),
    ],
    profile: ProfileOption = None,
    sets: SetOption = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Where each image gets a folder of results.")] = Path("out"),
    as_json: Annotated[bool, typer.Option("--json", help="Print each answer as a line of JSON.")] = False,
    cache: CacheOption = None,
    max_cost: CostOption = None,
    depth: Annotated[
        Path | None, typer.Option(help="A depth image of the same size (16-bit PNG in millimetres, or .npy in metres).")
    ] = None,
    camera: Annotated[Path | None, typer.Option(help="Its camera: JSON with fx, fy, cx, cy, or the matrix K.")] = None,
    depth_scale: Annotated[float, typer.Option(min=1e-9, help="Metres per unit of an integer depth image.")] = 0.001,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace earlier results instead of writing NAME-2, NAME-3, ...")
    ] = False,
) -> None:
    """Find the part to act on, in images, folders or globs.

    Writes OUT/NAME/ with affordance.json, mask.png, overlay.png and, when a Dreamer ran, imagination.png.
    With --depth and --camera also action.json and action.png: contact points in metres and grasps for a gripper.
    Exits with 1 if an image failed or its answer is not certain enough.
    """
    if (depth is None) != (camera is None):
        raise InputError("--depth and --camera go together: the depth image and the camera it was taken with")

    named, instruction = split_arguments(arguments)
    settings = common.settings(profile, sets, engine__cache=cache, engine__max_cost=max_cost)
    samples = name_results(find_sources(named))
    make_folder(out)
    if depth is not None and len(samples) > 1:
        raise InputError(f"--depth belongs to one image, and {len(samples)} are named")
    folders = {name: out / name if overwrite else free_folder(out, name) for name in samples}
    sensor = None if depth is None or camera is None else Sensor(depth, camera, depth_scale)
    failed = _run(settings, samples, instruction, folders, as_json, sensor)
    raise typer.Exit(common.SOME_FAILED if failed else common.OK)


@dataclass(frozen=True)
class Sensor:
    """The files of an image's depth and camera."""

    depth: Path
    camera: Path
    scale: float

    def plan(self, affordance: Affordance, folder: Path) -> ActionPlan:
        """Contacts and grasps of an answer, written to its folder.

        Raises:
            InputError: a file cannot be read, or does not fit the image.
        """
        camera = Intrinsics.read(self.camera)
        plan = plan_action(affordance, depth=read_depth(self.depth, affordance.size_wh, self.scale), camera=camera)
        replace_file(folder / "action.json", json.dumps(plan.to_dict(), indent=1).encode())
        if affordance.image is not None:
            draw_plan(affordance.image, plan, camera).save(folder / "action.png")
        return plan


def _run(
    settings: Settings,
    samples: dict[str, Source],
    instruction: str,
    folders: dict[str, Path],
    as_json: bool,
    sensor: Sensor | None = None,
) -> int:
    """Predict, save and print; returns how many samples were not accepted."""
    queries = (Query(name, source.image, instruction) for name, source in samples.items())
    statuses: Counter[str] = Counter()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with (
        common.build_agent(settings) as agent,
        common.bar(*columns, hidden=len(samples) == 1) as progress,
    ):
        task = progress.add_task("predicting", total=len(samples))
        for query, affordance in engine.run(agent, queries, settings=settings.engine):
            label, folder = samples[query.id].label, folders[query.id]
            saved, plan = True, None
            try:
                affordance.save(folder)
                plan = sensor.plan(affordance, folder) if sensor and affordance.size_wh[0] else None
            except InputError as error:
                saved, affordance = False, replace(affordance, status="error", error=str(error))
            statuses[affordance.status] += 1
            if as_json:
                action = {"action": plan.to_dict()} if plan else {}
                print(json.dumps({"image": label, "out": str(folder), **affordance.to_dict(), **action}), flush=True)
            elif len(samples) == 1:
                _show(affordance, folder if saved else None, plan)
            else:
                colour = {"ok": "green", "abstained": "yellow"}.get(affordance.status, "red")
                line = Text.assemble((f"{affordance.status:10}", colour), f"{label}: {affordance.summary}")
                common.output().print(line)
            progress.advance(task)
    failed = statuses["error"] + statuses["invalid"]
    if len(samples) > 1:
        unsure = f", {statuses['abstained']} unsure" if statuses["abstained"] else ""
        place = next(iter(folders.values())).parent
        say(f"{len(samples) - failed} of {len(samples)} answered{unsure}, {failed} failed; results in {place}/")
    return failed + statuses["abstained"]


def _show(affordance: Affordance, folder: Path | None, plan: ActionPlan | None = None) -> None:
    """Print an answer; `folder` holds its files, None if they could not be written."""
    console = common.output()
    answered = affordance.status in ("ok", "abstained")
    rows: list[tuple[str, str]] = [
        ("part" if answered else "answer", affordance.phrase if answered else affordance.summary)
    ]
    if affordance.confidence is not None:
        rows.append(("sure" if affordance.status == "ok" else "unsure", certainty(affordance)))
    if affordance.target and affordance.target.thinking:
        rows.append(("thinking", affordance.target.thinking))
    if affordance.imagination:
        rows.append(("imagined", affordance.imagination.prompt))
    if answered:
        share = affordance.mask.mean() if affordance.mask.size else 0.0
        rows.append(("box", "; ".join(", ".join(f"{x:.0f}" for x in box) for box in affordance.boxes_xyxy) or "none"))
        rows.append(("points", "; ".join(f"({x:.0f}, {y:.0f})" for x, y in affordance.points_xy) or "none"))
        rows.append(("mask", f"{int(affordance.mask.sum())} pixels, {share:.1%} of the image"))
    rows += _action_rows(plan) if plan else []
    rows.append(("took", _took(affordance.trace)))
    if folder is not None:
        name, file = ("file", "affordance.json") if affordance.image is None else ("overlay", "overlay.png")
        rows.append((name, str(folder / file)))
    for name, value in rows:
        colour = {"answer": "red", "unsure": "yellow", "sure": "green"}.get(name, "")
        console.print(Text.assemble((f"{name:>9}  ", "bold cyan"), (value, colour)))
    if affordance.status == "abstained":
        say("not certain enough: the mask is the best guess; look at the overlay, or lower verifier.accept")


def _action_rows(plan: ActionPlan) -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for contact in plan.contacts[:1]:
        at = "not measured" if contact.position_xyz is None else _metres(contact.position_xyz)
        rows.append(("contact", f"{at}{': ' + contact.reason if contact.reason else ''}"))
    if plan.grasps:
        best = plan.grasps[0]
        grasp = f"{len(plan.grasps)}, best at {_metres(best.pose[:3, 3])}, {1000 * best.width:.0f} mm wide"
        rows.append(("grasps", f"{grasp}, score {best.score:.2f}"))
    else:
        rows.append(("grasps", f"none: {plan.reason}"))
    return rows


def _metres(xyz: Any) -> str:
    return f"({', '.join(f'{float(v):.3f}' for v in xyz)}) m"


def certainty(affordance: Affordance) -> str:
    """ "0.34: no mug among the things seen": the confidence, and for an unsure answer its worst check."""
    worst = min(affordance.checks, key=lambda check: 1.0 if check.value is None else check.value, default=None)
    reason = f": {worst.note}" if worst and worst.note and affordance.status == "abstained" else ""
    return f"{affordance.confidence:.2f}{reason}"


def _took(trace: Trace) -> str:
    """ "1.20 s in 2 model calls, $0.0040, and 1 answer from the cache"."""
    cached = sum(step.cached for step in trace.steps)
    asked = len(trace.steps) - cached
    parts: list[str] = []
    if asked or not cached:
        cost = f", ${trace.cost:.4f}" if trace.cost else ""
        parts.append(f"{trace.seconds:.2f} s in {asked} model call{'' if asked == 1 else 's'}{cost}")
    if cached:
        parts.append(f"{cached} answer{'' if cached == 1 else 's'} from the cache")
    return ", and ".join(parts)
