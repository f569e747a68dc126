"""Write a set of samples.

    out/
      set.json                what it is made with: seed, split, things, renderer, versions; written first
      samples.jsonl           one row per sample, paths beside it
      images/0003-mug.jpg     the picture
      masks/0003-mug.png      the answer: 255 where an asked part is seen
      regions/0003-mug.png    0, or 1, 2, ...: which of the asked parts a pixel belongs to
      objects/0003-mug.png    255 where the thing is seen
      depth/0003-mug.png      16 bit, millimetres along the camera's axis, 0 where unknown

A row, shortened:

    {"id": "sim-0-0003-mug", "image": "images/0003-mug.jpg", "mask": "masks/0003-mug.png",
     "instruction": "Pick the mug up by its handle.", "object_name": "mug",
     "object_part": "the handle of the mug", "affordance": "grasp", "direct": true, "choose": "any",
     "boxes_xyxy": [[310, 202, 371, 290]], "points_xy": [[352.5, 247.5]], "visible_share": 0.93,
     "occluded_share": 0.05, "cut_share": 0.02, "camera_matrix": [[...]], "camera_pose": [[...]], ...}

The same seed gives the same bytes with the same versions on the same renderer. Every sample depends on
the seed and its number alone, so the number of workers changes nothing, and a set that was broken off
goes on after its last row.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, cast

import numpy as np
from PIL import Image

from a4agent.errors import ConfigError, DataError, ResourceError
from a4agent.files import is_draft, replace_file
from a4agent.imaging.masks import deepest_point, tight_box
from a4agent.sim.assets import check_installed
from a4agent.sim.backend import check_renderer, mujoco
from a4agent.sim.catalogue import Catalogue, Split, built_in, read_catalogue
from a4agent.sim.draw import Drawn, Plan, draw_sample, plan_set

FORMAT = 1
JPEG_QUALITY = 92
DEPTH_SCALE = 0.001
"""Metres in one unit of a depth picture."""


def make_set(
    out: Path,
    *,
    n: int = 200,
    seed: int = 0,
    split: Split | None = "test",
    catalogue_path: Path | None = None,
    workers: int = 1,
    on_sample: Callable[[int, int], None] | None = None,
) -> Path:
    """Write `n` samples of a split (None: of both) into `out` and return it.

    `out` is a new or empty folder, or one where the same set was begun: what is there is kept.

    Args:
        catalogue_path: declarations to use instead of the built-in ones.
        workers: processes that draw; the files do not depend on it.
        on_sample: called with (done, n) after each sample.

    Raises:
        MissingExtraError: mujoco or an asset package is not installed.
        ConfigError: `out` holds something else already, n is not positive, or the split is empty.
        DataError: a declaration does not fit its file, or hides its part; or `out` cannot be written.
        ResourceError: mujoco finds no off-screen renderer, or a worker was killed.
    """
    catalogue = _catalogue(catalogue_path)
    versions = check_installed(catalogue)
    renderer = check_renderer()
    if n < 1:
        raise ConfigError(f"a set has at least one sample, not {n!r}: --n 200")
    plans = list(plan_set(catalogue, n, seed, split))
    about = {
        "benchmark": "sim",
        "format": FORMAT,
        "n": n,
        "seed": seed,
        "split": split or "all",
        "things": hashlib.sha256(catalogue.model_dump_json().encode()).hexdigest()[:16],
        "renderer": renderer,
        "versions": {"mujoco": mujoco().__version__, **versions},
        "licences": {name: package.licence for name, package in catalogue.packages.items()},
    }
    try:
        kept = _begin(out, about)
        jobs = [(out, plan, catalogue_path) for plan in plans[len(kept) :]]
        # Not appended: should two processes write the same set, they write the same bytes to the same places.
        with (out / "samples.jsonl").open("r+b", buffering=0) as lines:
            lines.seek(sum(map(len, kept)))
            for done, row in enumerate(_rows(jobs, workers), start=len(kept) + 1):
                lines.write(json.dumps(row, ensure_ascii=False).encode() + b"\n")
                if on_sample:
                    on_sample(done, n)
    except OSError as error:
        raise DataError(f"{str(out)!r} cannot be written: {error}; name another folder with --out") from error
    except BrokenProcessPool as error:
        raise ResourceError(
            "a process that draws was killed, likely for want of memory; the same command with --workers 1 goes on"
        ) from error
    return out


def _begin(out: Path, about: dict[str, Any]) -> list[bytes]:
    """Make the folders of a set; the rows that it has already.

    Raises ConfigError if the folder holds anything but this set.
    """
    card = out / "set.json"
    if card.is_file():
        _check_same(out, card, about)
    elif out.exists() and (not out.is_dir() or not all(map(is_draft, out.iterdir()))):
        raise ConfigError(f"{str(out)!r} holds something already; name a new folder with --out")
    else:
        replace_file(card, (json.dumps(about, indent=2) + "\n").encode())
    for folder in ("images", "masks", "regions", "objects", "depth"):
        (out / folder).mkdir(exist_ok=True)
    rows = out / "samples.jsonl"
    rows.touch()
    return [row for row in rows.read_bytes().splitlines(keepends=True) if row.endswith(b"\n")]


def _check_same(out: Path, card: Path, about: dict[str, Any]) -> None:
    try:
        found = json.loads(card.read_text(encoding="utf-8"))
    except ValueError:
        found = None
    if not isinstance(found, dict):
        raise ConfigError(f"{str(out)!r} holds something already; name a new folder with --out")
    differs = next((name for name in about if found.get(name) != about[name]), None)
    if differs:
        raise ConfigError(
            f"{str(out)!r} holds another set, with {differs} {found.get(differs)!r} where {about[differs]!r} is asked "
            "for; name a new folder with --out"
        )


def _catalogue(path: Path | None) -> Catalogue:
    return built_in() if path is None else read_catalogue(path)


Job = tuple[Path, Plan, "Path | None"]


def _rows(jobs: list[Job], workers: int) -> Iterator[dict[str, Any]]:
    if workers <= 1 or len(jobs) <= 1:
        yield from map(_work, jobs)
        return
    # Spawned, because a forked child would share the parent's graphics context.
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(jobs)), mp_context=spawn, initializer=_end_with_parent) as pool:
        yield from pool.map(_work, jobs)


def _end_with_parent() -> None:
    """See that this process ends when its parent is killed: it would wait for work for ever."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _work(job: Job) -> dict[str, Any]:
    out, plan, catalogue_path = job
    return write_sample(draw_sample(_catalogue(catalogue_path), plan), out)


def write_sample(drawn: Drawn, out: Path) -> dict[str, Any]:
    """Write the pictures of one sample and return its row."""
    plan = drawn.plan
    mask = drawn.regions > 0
    depth = np.clip(np.round(drawn.depth / DEPTH_SCALE), 0, 65535)
    depth[depth == 65535] = 0
    files: dict[str, tuple[str, Any]] = {
        "image": ("images/{}.jpg", drawn.image),
        "mask": ("masks/{}.png", mask.astype(np.uint8) * 255),
        "regions": ("regions/{}.png", drawn.regions),
        "object_mask": ("objects/{}.png", drawn.thing.astype(np.uint8) * 255),
        "depth": ("depth/{}.png", depth.astype(np.uint16)),
    }
    paths = {name: pattern.format(plan.stem) for name, (pattern, _) in files.items()}
    for name, (_, pixels) in files.items():
        options: dict[str, Any] = {"quality": JPEG_QUALITY, "subsampling": 0} if name == "image" else {}
        Image.fromarray(pixels).save(out / paths[name], **options)

    height, width = mask.shape
    numbers = [number for number in range(1, len(plan.task.parts) + 1) if (drawn.regions == number).any()]
    regions = [drawn.regions == number for number in numbers]
    return {
        "id": f"sim-{plan.seed}-{plan.stem}",
        "image": paths["image"],
        "mask": paths["mask"],
        "instruction": plan.task.say,
        "object_name": plan.thing.name,
        "object_part": plan.thing.phrase(plan.task),
        "affordance": plan.task.affordance,
        "direct": plan.task.direct,
        "choose": plan.task.choose,
        "parts": [plan.task.parts[number - 1] for number in numbers],
        "region_numbers": numbers,
        "boxes_xyxy": [[int(edge) for edge in cast(Any, tight_box(region))] for region in regions],
        "points_xy": [cast(Any, deepest_point(region)).tolist() for region in regions],
        "regions": paths["regions"],
        "object_mask": paths["object_mask"],
        "depth": paths["depth"],
        "depth_scale": DEPTH_SCALE,
        "camera_matrix": drawn.camera.matrix.round(4).tolist(),
        "camera_pose": drawn.camera.pose.round(6).tolist(),
        "size_wh": [width, height],
        "visible_share": round(drawn.shares.visible, 4),
        "occluded_share": round(drawn.shares.occluded, 4),
        "cut_share": round(drawn.shares.cut, 4),
        "picture_share": round(float(mask.mean()), 5),
        "split": plan.thing.split,
        "package": plan.thing.package,
        "props": list(drawn.scene.props),
        "arm": drawn.scene.arm,
    }
