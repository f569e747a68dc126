"""`a4 track` and `a4 annotate`: the part to act on in every frame of a video."""

from __future__ import annotations

import json
import time
from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from a4agent.cli import common
from a4agent.cli.common import CacheOption, CostOption, ProfileOption, SetOption, say
from a4agent.cli.sources import free_folder
from a4agent.errors import InputError
from a4agent.imaging.masks import encode_rle
from a4agent.imaging.save import make_folder
from a4agent.types import Affordance
from a4agent.video.annotate import annotate as label
from a4agent.video.frames import OverlayVideo, open_frames
from a4agent.video.track import FoundFrame
from a4agent.video.track import track as follow
from a4agent.video.trackers import create

SourceArgument = Annotated[str, typer.Argument(metavar="VIDEO", help="A video file, a folder of images, or camera:0.")]
InstructionArgument = Annotated[str, typer.Argument(metavar="INSTRUCTION", help="What to do, in quotes.")]


def track(
    source: SourceArgument,
    instruction: InstructionArgument,
    profile: ProfileOption = None,
    sets: SetOption = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="The folder to write.")] = Path("out/track"),
    tracker: Annotated[str, typer.Option(help="flow (OpenCV) or sam2-video.")] = "flow",
    every: Annotated[int | None, typer.Option(min=1, help="Ground again after at most this many frames.")] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Stop after this many frames.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print each frame as a line of JSON.")] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace earlier results instead of writing OUT-2, OUT-3, ...")
    ] = False,
) -> None:
    """Follow the part to act on through a video.

    Writes OUT/overlay.mp4 and OUT/frames.jsonl, a line for each frame. The part is grounded in the first frame, and
    again whenever the tracker loses it.
    """
    settings = common.settings(profile, sets)
    origins: Counter[str] = Counter()
    grounded: list[int] = []
    part = instruction
    started = time.monotonic()
    with open_frames(source) as frames, common.build_agent(settings) as agent:
        out = out if overwrite else free_folder(out.parent, out.name, "frames.jsonl")
        make_folder(out)
        expected = min(filter(None, (frames.count, limit)), default=None)
        video = OverlayVideo(out / "overlay.mp4", frames.rate)
        try:
            with (
                common.bar(hidden=as_json) as progress,
                (out / "frames.jsonl").open("w", encoding="utf-8") as lines,
            ):
                task = progress.add_task("tracking", total=expected)
                for found in follow(agent, frames, instruction, create(tracker), every=every):
                    line = json.dumps(_record(found))
                    lines.write(line + "\n")
                    if as_json:
                        print(line, flush=True)
                    if found.affordance is not None:
                        grounded.append(found.index)
                        part = found.affordance.phrase
                    video.write(found.frame, found.mask, f"{found.source}: {part}", found.source != "lost")
                    origins[found.source] += 1
                    progress.advance(task)
                    if limit is not None and found.index + 1 >= limit:
                        break
        finally:
            video.close()
        if frames.ended_early:
            common.warn(f"{frames.ended_early}; what was tracked is kept")
    seconds = time.monotonic() - started
    total = sum(origins.values())
    shown = ", ".join(map(str, grounded[:10])) + (", ..." if len(grounded) > 10 else "")
    rate = f"{_frames(total)}, {total / seconds:.1f} a second"
    say(f"{rate}; grounded in {_frames(len(grounded))} ({shown}); lost in {_frames(origins['lost'])}")
    say(f"written to {out}/overlay.mp4 and frames.jsonl")
    raise typer.Exit(common.SOME_FAILED if origins["lost"] == total else common.OK)


def _frames(count: int) -> str:
    return f"{count} frame{'' if count == 1 else 's'}"


def _record(found: FoundFrame) -> dict[str, object]:
    asked = found.affordance
    return {
        "frame": found.index,
        "source": found.source,
        "quality": None if found.quality is None else round(float(found.quality), 4),
        "mask": encode_rle(found.mask),
        "status": asked.status if asked else None,
        "object_part": asked.phrase if asked else None,
        "error": asked.error if asked else None,
    }


def annotate(
    source: SourceArgument,
    instruction: InstructionArgument,
    out: Annotated[Path, typer.Option("--out", "-o", help="The folder to write, or to continue.")],
    profile: ProfileOption = None,
    sets: SetOption = None,
    cache: CacheOption = None,
    max_cost: CostOption = None,
) -> None:
    """Label every frame of a video or folder.

    Writes OUT/annotations.parquet and OUT/coco.json: masks, boxes, points and confidence. A run that was stopped
    continues with the missing frames.
    """
    if source.startswith("camera:"):
        raise InputError("a camera has no end; record a video first, or use `a4 track`")
    settings = common.settings(profile, sets, engine__cache=cache, engine__max_cost=max_cost)
    statuses: Counter[str] = Counter()
    with open_frames(source) as frames, common.build_agent(settings) as agent, common.bar() as progress:
        task = progress.add_task("annotating", total=frames.count)

        def on_frame(affordance: Affordance) -> None:
            statuses[affordance.status] += 1
            progress.advance(task)

        recipe = {"source": str(Path(source).resolve()), "profile": settings.name}
        count = label(agent, frames, instruction, out, settings=settings.engine, recipe=recipe, on_frame=on_frame)
        if frames.ended_early:
            common.warn(f"{frames.ended_early}; what was annotated is kept")
    counted = ", ".join(f"{number} {status}" for status, number in sorted(statuses.items())) or "nothing new"
    say(f"{count} frames in {out}/ ({counted})")
    raise typer.Exit(common.SOME_FAILED if statuses["error"] + statuses["invalid"] else common.OK)
