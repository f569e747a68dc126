"""A run, or two compared, as one HTML file: opens without a network and stays responsive with thousands of samples.

The page's frame (scores, published numbers, categories, stages) is rendered here. The samples are JSON that
page/page.js draws as they scroll into view; pictures are separate text elements that the browser decodes then. Masks
are scaled to their picture and stay run-length encoded.
"""

from __future__ import annotations

import base64
import json
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from PIL import Image

from a4agent import metrics
from a4agent.engine.pipeline import ordered_map
from a4agent.errors import DataError, InputError
from a4agent.imaging.encode import encoded
from a4agent.imaging.load import load_image
from a4agent.imaging.masks import decode_rle
from a4agent.redaction import redact
from a4agent.runs import published, scores, trust
from a4agent.runs.compare import RunPair
from a4agent.runs.manifest import LEAKS
from a4agent.runs.store import PICTURE_SIDE, STATUSES, Record, Run, write_atomically
from a4agent.runs.tables import group_of

LONGEST_ANSWER = 4000
LARGEST_ANIMATION = 1_000_000


def write_report(run: Run, path: Path | None = None) -> Path:
    """Write the report to `path` (None: report.html in the run folder); returns the path.

    Raises:
        DataError: the run has no samples yet.
    """
    if not run.records:
        raise DataError(f"{str(run.folder)!r} has no samples yet; start it again with `a4 bench`")
    path = path or run.folder / "report.html"
    write_atomically(path, render(run).encode("utf-8", "replace"))
    return path


def render(run: Run) -> str:
    """The page as text."""
    samples, pictures = _samples(run, run.records.values(), picture_side(len(run.records)))
    found = scores.score(run)
    return _filled(
        "page",
        run=run,
        identity=run.manifest.identity,
        about=run.manifest.about,
        data_name=Path(str(run.manifest.about.get("data", ""))).name,
        sessions=run.manifest.sessions,
        manifest=json.dumps({**run.manifest.identity, "about": run.manifest.about}, indent=2, ensure_ascii=False),
        scores=found,
        protocol=metrics.protocol_of(found.protocol),
        measures=[(label, getattr(found, name), found.intervals.get(name)) for name, label in metrics.MEASURES.items()],
        published=_published(run, found),
        further=[
            (scores.measure_name(name), mean, _percent if name == "contact" else _plain)
            for name, mean in scores.measures(run).items()
        ],
        trust=trust.trust(run),
        trust_measures=trust.MEASURES,
        leaks=[(question, run.manifest.leaks[name]) for name, question in LEAKS.items()],
        groups=scores.by_group(run),
        statuses=[(status, scores.statuses(run).get(status, 0)) for status in STATUSES],
        outcomes=[(name, n) for name in scores.OUTCOMES if (n := sum(s["outcome"] == name for s in samples))],
        histogram=_histogram(samples),
        errors=scores.errors(run),
        stages=_stages(run.records.values()),
        cost=sum(record.cost for record in run.records.values()),
        samples=samples,
        pictures=pictures,
    )


def write_comparison(pair: RunPair, path: Path) -> Path:
    """Write two runs side by side as one page; returns its path.

    Raises:
        DataError: it cannot be written, or a mask is damaged.
    """
    write_atomically(path, render_comparison(pair).encode("utf-8", "replace"))
    return path


def render_comparison(pair: RunPair) -> str:
    """The page as text: the paired changes, and both answers to each sample whose IoU crossed 0.5."""
    runs = (pair.first, pair.second)
    crossed = sorted(
        (*pair.result.gained, *pair.result.lost),
        key=lambda id: (-abs(pair.second.records[id].iou - pair.first.records[id].iou), id),
    )
    side = picture_side(len(crossed))
    sides = [_samples(run, [run.records[id] for id in crossed], side) for run in runs]
    lines = pair.lines()
    ends = [abs(end) for line in lines if line.percent for end in (line.change.low, line.change.high) if end == end]
    return _filled(
        "compare",
        names=[_name(run, runs) for run in runs],
        benchmark=pair.first.manifest.identity["benchmark"],
        result=pair.result,
        lines=lines,
        reach=max([*ends, 0.01]),
        changed=[line.replace(" there, ", " → ").removesuffix(" here") for line in pair.changed],
        samples=[list(both) for both in zip(sides[0][0], sides[1][0], strict=True)],
        pictures={**sides[1][1], **sides[0][1]},
    )


def _name(run: Run, runs: Sequence[Run]) -> str:
    """A run's label, or its folder's name where both have the same label."""
    return run.manifest.label if len({one.manifest.label for one in runs}) > 1 else run.folder.resolve().name


def _filled(name: str, **values: Any) -> str:
    """The page `name`.html with its style and scripts."""
    from jinja2 import Environment, StrictUndefined

    page = files("a4agent.runs") / "page"
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined)
    environment.filters.update(percent=_percent, signed=_signed)
    css, masks_js, js, frame = (
        (page / file).read_text(encoding="utf-8") for file in ("page.css", "masks.js", f"{name}.js", f"{name}.html")
    )
    return environment.from_string(frame).render(css=css, masks_js=masks_js, js=js, **values)


def _samples(run: Run, records: Collection[Record], side: int) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """The records for page.js, and their pictures in base64 by the stem of their file."""
    files_of = dict.fromkeys(name for record in records for name in record.pictures.values())
    embedded = ordered_map(lambda name: _embedded(run.folder, name, side), files_of)
    pictures = {name: data for name, data in zip(files_of, embedded, strict=True) if data}
    samples = list(ordered_map(lambda record: _sample(record, side, pictures), records))
    return samples, {Path(name).stem: data for name, data in pictures.items()}


def picture_side(samples: int) -> int:
    """Pixels of the longer side of the embedded pictures: the file stays in the tens of megabytes."""
    return 640 if samples <= 200 else 480 if samples <= 800 else 320


def _sample(record: Record, side: int, pictures: Mapping[str, str]) -> dict[str, Any]:
    """One sample for page.js."""
    row = record.row
    width, height = row["size_wh"]
    scale = min(1.0, side / max(width, height, 1))
    view = (max(1, round(width * scale)), max(1, round(height * scale)))
    try:
        mask, truth = (small_mask(rle, view) for rle in (row["mask"], record.truth))
    except DataError as error:
        raise DataError(f"the mask of sample {record.id!r} is damaged: {error}; remove its line") from error
    names = {kind: Path(name).stem for kind, name in record.pictures.items() if name in pictures}
    target = row["target"] or {}
    found = {
        "id": record.id,
        "status": record.status,
        "outcome": scores.outcome(record),
        "iou": round(record.iou, 4),
        "category": record.category,
        "tags": record.tags,
        "instruction": row["instruction"],
        "part": target.get("object_part", ""),
        "thinking": target.get("thinking", ""),
        "prompt": (row["imagination"] or {}).get("prompt", ""),
        "size": [width, height],
        "view": view,
        "boxes": row["boxes_xyxy"],
        "points": row["points_xy"],
        "mask": mask,
        "truth": truth,
        "original": names.get("original"),
        "imagination": names.get("imagination"),
        "frames": names.get("frames"),
        "animation": names.get("animation"),
        "error": row["error"] or "",
        "confidence": row.get("confidence"),
        "checks": row.get("checks") or [],
        "measures": record.measures,
        "seconds": round(record.seconds, 3),
        "cost": record.cost,
        "pixels": [row["intersection"], row.get("prediction_pixels"), row["union"]],
        "steps": [_step(step) for step in row["trace"]],
    }
    return redact(found)


def _step(step: Mapping[str, Any]) -> dict[str, Any]:
    kept = ("stage", "role", "expert", "seconds", "cached", "attempts", "tokens_in", "tokens_out", "cost", "error")
    answer = step.get("answer") or ""
    shown = answer if len(answer) <= LONGEST_ANSWER else f"{answer[:LONGEST_ANSWER]}… (all of it is in samples.jsonl)"
    return {key: step.get(key) for key in kept} | {"answer": shown}


def small_mask(mask: Mapping[str, Any], view: tuple[int, int]) -> list[int]:
    """A COCO RLE brought to `view` (width, height), as plain run lengths down the columns, background first."""
    pixels = metrics.nearest_neighbour(decode_rle(mask), (view[1], view[0])).ravel(order="F")
    if not pixels.size:
        return []
    edges = np.flatnonzero(np.diff(pixels)) + 1
    runs = np.diff(np.concatenate([[0], edges, [pixels.size]])).tolist()
    return [0, *runs] if pixels[0] else runs


def _embedded(folder: Path, name: str, side: int) -> str:
    """A picture of the run in base64; "" if its file is missing, damaged, too large or outside the run's folder.

    An animation (WebP) is embedded as it is, anything else is scaled down.
    """
    path = folder / name
    try:
        image = load_image(path, max_pixels=PICTURE_SIDE**2, inside=folder)
        if path.suffix == ".webp":
            kept = path.read_bytes() if path.stat().st_size <= LARGEST_ANIMATION else b""
            return base64.b64encode(kept).decode("ascii")
    except (InputError, OSError):
        return ""
    image.thumbnail((side, side), Image.Resampling.HAMMING)
    data = encoded(image, "WEBP", quality=75, method=2)  # half of a JPEG's bytes
    return base64.b64encode(data).decode("ascii")


def _published(run: Run, found: metrics.Scores) -> dict[str, Any] | None:
    """The paper's table of this benchmark by group, best first in each; None if it has none."""
    benchmark = str(run.manifest.identity["benchmark"])
    table = published.of_benchmark(benchmark)
    if table is None:
        return None
    columns = [i for i, column in enumerate(table.columns) if column.benchmark == benchmark]
    rows: list[dict[str, Any]] = [
        {
            "name": name,
            "values": [values[i] / 100 for i in columns],
            "ours": False,
            "interval": None,
            "group": table.group(name),
        }
        for name, values in table.rows.items()
    ]
    ours = [getattr(found, table.columns[i].measure) for i in columns]
    interval = found.intervals.get("giou")
    name, group = run.manifest.label, group_of([run], table, run.manifest.label)
    rows.append({"name": name, "values": ours, "ours": True, "interval": interval, "group": group})
    rows.sort(key=lambda row: -row["values"][0] if row["values"][0] == row["values"][0] else 1)
    return {
        "title": f"{published.SOURCE}, table {table.number}",
        "columns": [metrics.MEASURES[table.columns[i].measure] for i in columns],
        "groups": [
            (heading, [row for row in rows if row["group"] == group])
            for group, heading in published.GROUPS.items()
            if any(row["group"] == group for row in rows)
        ],
        "notes": table.notes,
    }


def _histogram(samples: Iterable[Mapping[str, Any]]) -> list[int]:
    """How many samples have an IoU in each tenth; 1.0 belongs to the last."""
    counts = Counter(min(9, int(sample["iou"] * 10)) for sample in samples)
    return [counts[i] for i in range(10)]


def _stages(records: Iterable[Record]) -> list[dict[str, Any]]:
    """The calls of each expert and what they took, in the order of the stages.

    Seconds are not summed: each request of a batch has the seconds of the whole batch.
    """
    groups: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
    for record in records:
        for step in record.row["trace"]:
            groups.setdefault((step["stage"], step["role"], step["expert"]), []).append(step)
    order = {"dreamer": 0, "thinker": 1, "spotter": 2, "verifier": 3}
    table: list[dict[str, Any]] = []
    for (stage, role, expert), steps in sorted(groups.items(), key=lambda item: order.get(item[0][0], 4)):
        seconds = [step["seconds"] for step in steps if not step.get("cached")]
        known = [step["cost"] for step in steps if step.get("cost") is not None and not step.get("cached")]
        table.append(
            {
                "stage": stage,
                "role": role,
                "expert": expert,
                "asked": len(steps),
                "cached": sum(bool(step.get("cached")) for step in steps),
                "failed": sum(bool(step.get("error")) for step in steps),
                "median": median(seconds) if seconds else None,
                "tokens": sum((step.get("tokens_in") or 0) + (step.get("tokens_out") or 0) for step in steps),
                "cost": sum(known) if known else None,
            }
        )
    return table


def _percent(value: float | None, decimals: int = 1) -> str:
    return "–" if value is None or value != value else f"{100 * value:.{decimals}f}"


def _signed(value: float) -> str:
    return "–" if value != value else f"{100 * value:+.1f}".replace("-", "−")


def _plain(value: float) -> str:
    return f"{value:.3f}"
