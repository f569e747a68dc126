"""Write a set of samples.

    out/
      set.json                what it was made with: seed, split, versions of mujoco and of the assets
      samples.jsonl           one row a sample, paths beside it
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
the seed and its number alone, so the number of workers changes nothing.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from a4agent.errors import ConfigError
from a4agent.sim.assets import check_installed
from a4agent.sim.backend import check_renderer, mujoco
from a4agent.sim.draw import Drawn, Plan, draw_sample, plan_set
from a4agent.sim.things import Catalogue, Split, built_in, read_catalogue

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
    """Write `n` samples of a split (None: of both) into `out`, a new or empty folder, and return it.

    Args:
        catalogue_path: declarations to use instead of the built-in ones.
        workers: processes that draw; the files do not depend on it.
        on_sample: called with (done, n) after each sample.

    Raises:
        MissingExtraError: mujoco or an asset package is not installed.
        ConfigError: `out` holds something already, n is not positive, or the split is empty.
        DataError: a declaration does not fit its file, or hides its part.
        ResourceError: mujoco finds no off-screen renderer.
    """
    catalogue = _catalogue(catalogue_path)
    versions = check_installed(catalogue)
    check_renderer()
    if n < 1:
        raise ConfigError(f"a set has at least one sample, not {n!r}: --n 200")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f"{str(out)!r} holds something already; name a new folder with --out")
    plans = list(plan_set(catalogue, n, seed, split))
    for folder in ("images", "masks", "regions", "objects", "depth"):
        (out / folder).mkdir(parents=True, exist_ok=True)

    with (out / "samples.jsonl").open("w", encoding="utf-8", newline="\n") as lines:
        for done, row in enumerate(_rows([(out, plan, catalogue_path) for plan in plans], workers), start=1):
            lines.write(json.dumps(row, ensure_ascii=False) + "\n")
            if on_sample:
                on_sample(done, n)
    about = {
        "benchmark": "sim",
        "format": FORMAT,
        "n": n,
        "seed": seed,
        "split": split or "all",
        "versions": {"mujoco": mujoco().__version__, **versions},
        "licences": {name: package.licence for name, package in catalogue.packages.items()},
    }
    (out / "set.json").write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8", newline="\n")
    return out


def _catalogue(path: Path | None) -> Catalogue:
    return built_in() if path is None else read_catalogue(path)


Job = tuple[Path, Plan, "Path | None"]


def _rows(jobs: list[Job], workers: int) -> Iterator[dict[str, Any]]:
    if workers <= 1:
        yield from map(_work, jobs)
        return
    # Spawned, because a forked child would share the parent's graphics context.
    with ProcessPoolExecutor(min(workers, len(jobs)), mp_context=get_context("spawn")) as pool:
        yield from pool.map(_work, jobs)


def _work(job: Job) -> dict[str, Any]:
    out, plan, catalogue_path = job
    return write_sample(draw_sample(_catalogue(catalogue_path), plan), out)


def write_sample(drawn: Drawn, out: Path) -> dict[str, Any]:
    """Write the pictures of one sample and return its row."""
    from PIL import Image

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
        "boxes_xyxy": [_box(drawn.regions == number) for number in numbers],
        "points_xy": [_point(drawn.regions == number) for number in numbers],
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


def _box(region: np.ndarray) -> list[int]:
    rows, columns = np.flatnonzero(region.any(1)), np.flatnonzero(region.any(0))
    return [int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1]


def _point(region: np.ndarray) -> list[float]:
    """The middle of the pixel that lies deepest inside the region."""
    from scipy.ndimage import distance_transform_edt

    padded: Any = distance_transform_edt(np.pad(region, 1))
    inside: np.ndarray = padded[1:-1, 1:-1]
    row, column = np.unravel_index(int(inside.argmax()), region.shape)
    return [float(column) + 0.5, float(row) + 0.5]
