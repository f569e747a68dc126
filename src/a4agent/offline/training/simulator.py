"""Crops of the simulator's scenes, with exact part truth: how things look to a robot's camera.

Only things of the `dev` split are shown: those of `test` stay unseen, they are what `a4 bench sim` asks about.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from a4agent.offline.training.canvas import SIDE
from a4agent.offline.training.drawings import Drawing
from a4agent.offline.vocabulary import BODY, CONTROL, GRIP, LID, WORK
from a4agent.sim import appearance, sensor
from a4agent.sim.catalogue import USES, Catalogue, Thing, Use
from a4agent.sim.render import SceneRenderer
from a4agent.sim.scene import Scene, build_scene

HELD_OUT = ("latched door", "square nut")
"""Things of `dev` that training does not see either: its own test."""
LABELS = {
    "handle": GRIP, "grip": GRIP, "head": WORK, "blade": WORK, "frame": WORK, "nail": CONTROL, "plate": LID,
    "lower": BODY, "upper": BODY,
}  # fmt: skip
KINDS = {
    "drawer": "drawer", "hammer": "hammer", "mallet": "hammer", "faucet": "faucet", "lever": "lever",
    "latched door": "door", "box lid": "box",
}  # fmt: skip
"""The kind of each thing; others are of kind "other"."""
SIZE_WH = (400, 300)
VIEWS, CROPS = 4, 4


def crops(catalogue: Catalogue, rng: np.random.Generator, things: tuple[Thing, ...]) -> Iterator[Drawing]:
    """Crops without end, of random scenes of `things`."""
    while True:
        thing = things[rng.integers(len(things))]
        yield from _of_scene(catalogue, thing, rng)


def training_things(catalogue: Catalogue) -> tuple[Thing, ...]:
    """The `dev` things that stand on a table of ours: a room of their own would show things of `test` beside them."""
    return tuple(thing for thing in catalogue.split("dev") if thing.name not in HELD_OUT and not thing.in_place)


def _of_scene(catalogue: Catalogue, thing: Thing, rng: np.random.Generator) -> Iterator[Drawing]:
    yaw = appearance.draw_yaw(thing, rng)
    props = [catalogue.props[index] for index in rng.permutation(len(catalogue.props))[: rng.integers(0, 4)]]
    surfaces: dict[Use, tuple[str, str]] = {
        use: (pictures := catalogue.pictures(use))[rng.integers(len(pictures))] for use in USES
    }
    scene = build_scene(
        catalogue,
        thing,
        list(thing.parts),
        props=props,
        surfaces=surfaces,
        yaw=yaw,
        rng=rng,
    )
    appearance.furnish(scene, yaw, rng)
    with SceneRenderer(scene, appearance.widen(SIZE_WH)) as rendering:
        for _ in range(VIEWS):
            appearance.paint(scene, rng)
            appearance.light(scene, yaw, rng)
            camera = appearance.aim(scene, yaw, SIZE_WH, rng)
            labels = _label(scene, rendering.ids(camera))
            if (labels > 0).sum() < 300 or not np.isin(labels, [GRIP, WORK, CONTROL, LID]).any():
                continue
            image = sensor.expose(rendering.colour(camera), rng)
            for _ in range(CROPS):
                yield _crop(image, labels, KINDS.get(thing.name, "other"), rng)


def _label(scene: Scene, ids: np.ndarray) -> np.ndarray:
    """Geom ids (H, W) as part labels (H, W) uint8."""
    numbers = np.zeros(scene.model.ngeom + 1, np.uint8)  # the last entry is for id -1: nothing
    numbers[scene.thing_geoms] = GRIP if KINDS.get(scene.thing.name) == "hammer" else BODY
    for name, geoms in scene.part_geoms.items():
        numbers[geoms] = LABELS[name]
    return numbers[ids]


def _crop(image: np.ndarray, labels: np.ndarray, kind: str, rng: np.random.Generator) -> Drawing:
    """A square around the thing or around one of its parts, or beside it."""
    height, width = labels.shape
    pick = rng.random()
    if pick < 0.1:
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        half = rng.uniform(30, 120)
    else:
        shown = labels > 0 if pick < 0.6 else np.isin(labels, [GRIP, WORK, CONTROL, LID])
        rows, columns = np.flatnonzero(shown.any(1)), np.flatnonzero(shown.any(0))
        extent = max(np.ptp(rows), np.ptp(columns), 12) + 1
        half = extent / 2 * (rng.uniform(1.1, 1.9) if pick < 0.6 else rng.uniform(1.3, 4.0))
        half = min(half, min(height, width) / 2)
        x = (columns[0] + columns[-1]) / 2 + rng.normal() * 0.12 * half
        y = (rows[0] + rows[-1]) / 2 + rng.normal() * 0.12 * half
    matrix = np.array(
        [
            [SIDE / (2 * half), 0, SIDE / 2 - x * SIDE / (2 * half)],
            [0, SIDE / (2 * half), SIDE / 2 - y * SIDE / (2 * half)],
        ]
    )
    flags = cv2.INTER_AREA if half * 2 > SIDE else cv2.INTER_LINEAR
    cut = cv2.warpAffine(image, matrix, (SIDE, SIDE), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    parts = cv2.warpAffine(labels, matrix, (SIDE, SIDE), flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
    if (parts > 0).mean() < 0.02:
        return Drawing(cut, np.zeros_like(parts), "none")
    return Drawing(cut, parts, kind)
