"""Scenes from simulators, rendered on this machine, with truth exact to the pixel.

Licence: the pictures show assets of metaworld, gymnasium-robotics and robosuite (MIT; some models
Apache-2.0, see docs/sim.md). Where to get it: `a4 data make sim --out DIR`; there is no official scorer.
`a4agent.sim.make` says which files a set has and shows a row. Set and scorer are ours, so the protocol
is `strict`.

A task for which any of several parts will do ("open one of the drawers") has each of them as an
alternative to all of them together. Scores break down by the tags object, affordance, directness,
visible (share of the part that is seen) and size (of the part in the picture).
"""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from a4agent.benchmarks import files
from a4agent.benchmarks.base import Benchmark, Sample, Truth
from a4agent.errors import A4Error, DataError, InputError
from a4agent.files import system_cache
from a4agent.imaging.load import read_pixels
from a4agent.sim.assets import check_installed
from a4agent.sim.backend import check_renderer
from a4agent.sim.catalogue import built_in
from a4agent.sim.make import FORMAT, make_set
from a4agent.types import Query

log = logging.getLogger("a4agent")

RowT = TypeVar("RowT", bound=BaseModel)
DEFAULT_N, DEFAULT_SEED = 200, 0
SOURCE = "a4 data make sim --out DIR"
SIZES = ((0.003, "below 0.3 %"), (0.01, "0.3 to 1 %"), (0.04, "1 to 4 %"), (1.0, "above 4 %"))
VISIBLE = ((0.7, "below 70 %"), (0.95, "70 to 95 %"), (1.0, "above 95 %"))


class SceneRow(BaseModel):
    """A row of `samples.jsonl`, as far as it is read here; `a4agent.sim.make` says what the values mean."""

    id: str
    image: str
    mask: str
    instruction: str
    object_name: str
    object_part: str
    affordance: str
    direct: bool
    choose: Literal["any", "all"]
    regions: str
    object_mask: str
    region_numbers: list[int]
    visible_share: float = Field(ge=0, le=1)
    picture_share: float = Field(ge=0, le=1)
    depth: str
    depth_scale: float
    camera_matrix: list[list[float]]
    camera_pose: list[list[float]]


def make(out: Path, **options: Any) -> Path:
    """`sim.make.make_set`, for `a4 data make sim`."""
    return make_set(out, **options)


def missing() -> str:
    """What stands between this machine and `a4 data make sim`; "" if nothing does."""
    try:
        check_installed(built_in())
        check_renderer()
    except A4Error as error:
        return str(error)
    return ""


def create(path: str | Path | None = None) -> Benchmark:
    """Open a set that `a4 data make sim` wrote. Without a path: the default set, made in the cache at first use.

    Raises:
        DataError: not a set, or one that was not finished or is of a newer format.
        MissingExtraError: there is no path and no default set yet, and nothing to make it with.
    """
    root = files.folder(path or default_set(), "sim")
    about = files.read_json(root / "set.json")
    if not isinstance(about, dict) or about.get("benchmark") != "sim":
        raise DataError(f"{str(root / 'set.json')!r} does not describe a sim set; make one: {SOURCE}")
    about = cast("dict[str, Any]", about)
    if about.get("format") != FORMAT:
        raise DataError(f"{str(root)!r} has format {about.get('format')!r}, this version reads {FORMAT}; {SOURCE}")
    rows = read_rows(root)
    if len(rows) != about.get("n"):
        raise DataError(
            f"{str(root)!r} was not finished: it has {len(rows)} of {about.get('n')} samples; "
            f"the command that began it goes on: {SOURCE}"
        )
    named = [name for row in rows for name in (row.image, row.mask, row.regions)]
    return Benchmark(
        name="sim",
        licence="rendered from MIT and Apache-2.0 assets",
        source=SOURCE,
        root=root,
        size=len(rows),
        sample=lambda i: _sample(root, rows[i]),
        digest=files.digest([(root / "samples.jsonl").read_bytes(), *(files.sized(root, name) for name in named)]),
        options={"split": about.get("split"), "seed": about.get("seed")},
        revision=f"format {FORMAT}",
    )


def read_rows(root: Path) -> list[SceneRow]:
    """The rows of the set in the folder `root`.

    Raises:
        DataError: a row that `a4 data make sim` would not write; says which and what is wrong.
    """
    return checked_rows(root, SceneRow, SOURCE)


def checked_rows(root: Path, kind: type[RowT], source: str) -> list[RowT]:
    """The rows of a samples.jsonl as models of one kind.

    Raises:
        DataError: a row is not one; the message ends with `source`, where to get a set.
    """
    rows: list[RowT] = []
    for number, row in files.read_jsonl(root / "samples.jsonl"):
        try:
            rows.append(kind.model_validate(row))
        except ValidationError as error:
            wrong = "; ".join(f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors())
            raise DataError(f"line {number} of {str(root / 'samples.jsonl')!r}: {wrong}; {source}") from error
    return rows


def default_set() -> Path:
    """The folder of the default set (200 samples of the test split), rendered if it is not there.

    Raises what `a4agent.sim.make.make_set` raises.
    """
    name = f"sim-v{FORMAT}-test-{DEFAULT_SEED}-{DEFAULT_N}"
    return made_once(name, DEFAULT_N, lambda out: make_set(out, n=DEFAULT_N, seed=DEFAULT_SEED))


def made_once(name: str, samples: int, make: Callable[[Path], object]) -> Path:
    """The set `name` in the cache (A4_CACHE_DIR, else the system's), which `make` writes if it is not there."""
    chosen = os.environ.get("A4_CACHE_DIR")
    folder = (Path(chosen).expanduser() if chosen else system_cache()) / "sim" / name
    if not folder.is_dir():
        log.warning("rendering a set of %d samples once, in a few minutes, into %s", samples, folder)
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".making-") as making:
            made = Path(making) / "set"
            make(made)
            try:
                made.rename(folder)  # only a whole set has this name
            except OSError:
                if not folder.is_dir():  # another process may have been faster
                    raise
    return folder


@dataclass(frozen=True, eq=False)
class Geometry:
    """For lifting to 3D: `depth` (H, W) float32 metres, 0 where unknown; `matrix` (3, 3); `pose` (4, 4) to the world.

    In the convention of OpenCV and ROS: x right, y down, z into the picture, (0, 0) the centre of the first pixel.
    """

    depth: np.ndarray
    matrix: np.ndarray
    pose: np.ndarray


def read_geometry(root: Path, row: SceneRow) -> Geometry:
    """Depth and camera of one row of `samples.jsonl`.

    Raises:
        DataError: the depth picture is missing or cannot be read.
    """
    depth = _pixels(root, row.depth).astype(np.float32) * np.float32(row.depth_scale)
    return Geometry(depth, np.array(row.camera_matrix, np.float64), np.array(row.camera_pose, np.float64))


def read_regions(root: Path, row: SceneRow) -> tuple[np.ndarray, ...]:
    """The mask (H, W) bool of each part that the row asks for and that is seen, in the order of its `parts`.

    Raises:
        DataError: the picture of the regions is missing or cannot be read.
    """
    numbers = _pixels(root, row.regions)
    return tuple(numbers == number for number in row.region_numbers)


def _sample(root: Path, row: SceneRow) -> Sample:
    several = row.choose == "any" and len(row.region_numbers) > 1
    truth = Truth(
        load_mask=partial(files.read_mask_in, root, row.mask),
        object_name=row.object_name,
        object_part=row.object_part,
        affordance=row.affordance,
        category=row.object_name,
        tags={
            "object": row.object_name,
            "affordance": row.affordance,
            "directness": "direct" if row.direct else "indirect",
            "visible": _bin(row.visible_share, VISIBLE),
            "size": _bin(row.picture_share, SIZES),
        },
        load_alternatives=partial(read_regions, root, row) if several else None,
    )
    return Sample(Query(row.id, files.confined(root, row.image), row.instruction), truth)


def _pixels(root: Path, name: str) -> np.ndarray:
    try:
        return read_pixels(files.confined(root.resolve(), name))
    except InputError as error:
        raise DataError(str(error)) from error


def _bin(share: float, bins: tuple[tuple[float, str], ...]) -> str:
    return next(label for limit, label in bins if share <= limit)
