"""Label every frame of a video or folder: the part's mask, box, points and confidence, as Parquet and COCO.

    out/
      annotate.json          the job: source, instruction, profile
      frames.jsonl           one answer per frame, written as it comes; a stopped run continues from here
      annotations.parquet    one row per frame, with the column names of LeRobot datasets (frame_index, timestamp, ...)
      coco.json              images and annotations with run-length masks

Frames are independent samples of the engine, so they run many at once and come back in any order.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from a4agent import engine
from a4agent.agent import A4Agent
from a4agent.config import EngineSettings
from a4agent.errors import A4Error, DataError, InputError, require
from a4agent.files import replace_file
from a4agent.imaging.save import make_folder
from a4agent.interop.detections import to_coco
from a4agent.types import Affordance, Query
from a4agent.video.frames import Frames

JOURNAL, RECIPE = "frames.jsonl", "annotate.json"


def annotate(
    agent: A4Agent,
    frames: Frames,
    instruction: str,
    out: Path,
    *,
    settings: EngineSettings,
    recipe: dict[str, Any],
    on_frame: Callable[[Affordance], None] | None = None,
) -> int:
    """Answer every frame that `out` lacks and write the exports; returns the number of frames in `out`.

    Args:
        recipe: what identifies this job (source, profile, ...); a folder with another one is refused.

    Raises:
        InputError: `out` belongs to another job or is not writable.
        UserError, ProviderError, BudgetExceeded: see `engine.run`; the frames answered so far are kept.
    """
    make_folder(out)
    _claim(out, {**recipe, "instruction": instruction})
    done = {int(row["id"]) for row in _rows(out / JOURNAL)}

    def queries() -> Iterator[Query]:
        for index, picture in frames:
            if index not in done:
                yield Query(str(index), picture, instruction)

    try:
        with (out / JOURNAL).open("a", encoding="utf-8") as journal:
            for _, affordance in engine.run(agent, queries(), settings=settings):
                journal.write(json.dumps(affordance.to_dict()) + "\n")
                journal.flush()
                if on_frame is not None:
                    on_frame(affordance)
    finally:
        count = export(out, frames.rate)
    return count


def _claim(out: Path, recipe: dict[str, Any]) -> None:
    """Mark the folder as this job's; raise InputError if it is another's."""
    path = out / RECIPE
    if path.exists():
        known = json.loads(path.read_text(encoding="utf-8"))
        changed = [key for key in recipe if known.get(key) != recipe[key]]
        if changed:
            was, now = known.get(changed[0]), recipe[changed[0]]
            raise InputError(f"{str(out)!r} holds frames with {changed[0]} {was!r}, not {now!r}; choose another --out")
    elif (out / JOURNAL).exists():
        raise InputError(f"{str(out)!r} has {JOURNAL} but no {RECIPE}; choose another --out")
    else:
        replace_file(path, json.dumps(recipe, indent=1).encode())


def _rows(journal: Path) -> list[dict[str, Any]]:
    """The answers in a journal, each frame once. An unfinished last line is removed."""
    if not journal.exists():
        return []
    data = journal.read_bytes()
    whole = data[: data.rfind(b"\n") + 1]
    if len(whole) < len(data):
        replace_file(journal, whole)
    found: dict[str, dict[str, Any]] = {}
    for number, line in enumerate(whole.splitlines(), start=1):
        try:
            row = json.loads(line)
            found[str(int(row["id"]))] = row
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise DataError(
                f"line {number} of {str(journal)!r} is damaged: {error}; delete it and run again"
            ) from error
    return list(found.values())


def export(out: Path, rate: float) -> int:
    """Write annotations.parquet (with pyarrow) and coco.json from the journal; returns the number of frames."""
    rows = sorted(_rows(out / JOURNAL), key=lambda row: int(row["id"]))
    answers = [(int(row["id"]), Affordance.from_dict(row)) for row in rows]
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for index, answer in answers:
        width, height = answer.size_wh
        images.append({"id": index, "file_name": f"{index:06d}", "width": width, "height": height})
        annotations += to_coco(answer, image_id=index, first_id=len(annotations) + 1)
    part = next((answer.phrase for _, answer in answers), "part")
    coco = {"images": images, "annotations": annotations, "categories": [{"id": 1, "name": part}]}
    replace_file(out / "coco.json", json.dumps(coco).encode())
    try:
        arrow: Any = require("pyarrow", extra="bench")
        parquet: Any = require("pyarrow.parquet", extra="bench")
    except A4Error:
        return len(answers)
    table = arrow.Table.from_pylist([_parquet_row(index, answer, rate) for index, answer in answers])
    draft = out / ".annotations.parquet.tmp"
    parquet.write_table(table, draft)
    draft.replace(out / "annotations.parquet")
    return len(answers)


def _parquet_row(index: int, answer: Affordance, rate: float) -> dict[str, Any]:
    record = answer.to_dict()
    return {
        "episode_index": 0,
        "frame_index": index,
        "timestamp": index / rate,
        "task": answer.instruction,
        "status": answer.status,
        "confidence": answer.confidence,
        "object_part": answer.phrase,
        "boxes_xyxy": record["boxes_xyxy"],
        "points_xy": record["points_xy"],
        "mask_size": record["mask"]["size"],
        "mask_counts": record["mask"]["counts"],
        "error": answer.error,
    }
