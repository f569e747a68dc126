"""One sample: draw scenes and views of them until one shows the part that is asked for."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from a4agent.errors import ConfigError, DataError
from a4agent.sim import appearance, sensor
from a4agent.sim.catalogue import USES, Catalogue, Prop, Split, Task, Thing, Use
from a4agent.sim.render import SceneRenderer
from a4agent.sim.scene import Scene, build_scene

LEAST_VISIBLE = 0.35
"""The least share of a part that must be seen; of one of the parts where any of them will do."""
LEAST_PIXELS = 150
MOST_OF_PICTURE = 0.4
MOST_ARM = 0.3
"""The largest shares of a picture that the part and the robot's arm may take."""
SCENES, VIEWS = 8, 8
"""How many scenes, and views of each, are tried for one sample."""


@dataclass(frozen=True)
class Plan:
    """What sample `index` of the set with `seed` will ask."""

    seed: int
    index: int
    thing: Thing
    task: Task

    @property
    def stem(self) -> str:
        name = re.sub(r"[^\w-]+", "-", self.thing.name)
        return f"{self.index:04d}-{name}"


@dataclass(frozen=True)
class Shares:
    """Of all pixels the part would cover if nothing stood before it and the picture went on: they add up to one."""

    visible: float
    occluded: float
    cut: float


@dataclass(frozen=True, eq=False)
class Drawn:
    """A picture with its truth.

    `image` (H, W, 3) uint8; `regions` (H, W) uint8, 0 or the number of the task's part from 1;
    `thing` (H, W) bool; `depth` (H, W) float32 metres, 0 where unknown.
    """

    plan: Plan
    scene: Scene
    camera: appearance.Camera
    image: np.ndarray
    regions: np.ndarray
    thing: np.ndarray
    depth: np.ndarray
    shares: Shares


def plan_set(catalogue: Catalogue, n: int, seed: int, split: Split | None) -> Iterator[Plan]:
    """Which thing and task each of `n` samples shows: all things before any comes again, their tasks in turn.

    Raises ConfigError if nothing is declared for the split.
    """
    things = catalogue.split(split)
    if not things:
        raise ConfigError(f"no thing is declared for the split {split!r}")
    rng = np.random.default_rng([seed])
    first = [int(rng.integers(len(thing.tasks))) for thing in things]
    order: list[int] = []
    for index in range(n):
        turn = index // len(things)
        if not order:
            order = rng.permutation(len(things)).tolist()
        which = order.pop()
        thing = things[which]
        yield Plan(seed, index, thing, thing.tasks[(first[which] + turn) % len(thing.tasks)])


def draw_sample(catalogue: Catalogue, plan: Plan) -> Drawn:
    """Draw until the asked part is seen well enough. The result depends on the plan alone.

    Raises:
        DataError: no view of any scene showed the part: its declaration hides it.
    """
    for attempt in range(SCENES):
        rng = np.random.default_rng([plan.seed, plan.index, attempt])
        if drawn := _draw_scene(catalogue, plan, rng):
            return drawn
    raise DataError(
        f"{plan.thing.name!r}: the part {'/'.join(plan.task.parts)!r} was hidden or tiny in all {SCENES * VIEWS} "
        f"views; look at the thing's `front`, `spread`, `elevation` and `joints`"
    )


def _draw_scene(catalogue: Catalogue, plan: Plan, rng: np.random.Generator) -> Drawn | None:
    thing, task = plan.thing, plan.task
    yaw = appearance.draw_yaw(thing, rng)
    with_arm = bool(catalogue.arms) and rng.random() < 0.3
    scene = build_scene(
        catalogue,
        thing,
        task.parts,
        props=() if thing.in_place else _draw_props(catalogue, plan, rng),
        arm=catalogue.arms[rng.integers(len(catalogue.arms))] if with_arm else None,
        surfaces=_draw_surfaces(catalogue, rng),
        yaw=yaw,
        rng=rng,
    )
    appearance.furnish(scene, yaw, rng)
    appearance.paint(scene, rng)
    appearance.light(scene, yaw, rng)
    size = appearance.draw_size(rng)
    with SceneRenderer(scene, appearance.widen(size)) as rendering:
        for _ in range(VIEWS):
            camera = appearance.aim(scene, yaw, size, rng)
            ids = rendering.ids(camera)
            regions = _number(scene, ids)
            seen = _count(scene, regions)
            if seen.sum() < LEAST_PIXELS or seen.sum() > MOST_OF_PICTURE * regions.size:
                continue
            if np.isin(ids, scene.arm_geoms).mean() > MOST_ARM:
                continue
            alone = _number(scene, rendering.part_alone())
            whole = _count(scene, alone)
            each = seen / np.maximum(whole, 1)
            if (each.max() if task.choose == "any" else each.min()) < LEAST_VISIBLE:
                continue
            framed = _count(scene, camera.crop(alone)).sum()
            return Drawn(
                plan=plan,
                scene=scene,
                camera=camera,
                image=sensor.expose(rendering.colour(camera), rng),
                regions=regions,
                thing=np.isin(ids, scene.thing_geoms),
                depth=rendering.depth(camera),
                shares=Shares(
                    visible=float(seen.sum() / whole.sum()),
                    occluded=float((framed - seen.sum()) / whole.sum()),
                    cut=float(1 - framed / whole.sum()),
                ),
            )
    return None


def _draw_props(catalogue: Catalogue, plan: Plan, rng: np.random.Generator) -> list[Prop | Thing]:
    """Up to five props. Other things of the split join them only where the task names its object.

    So nothing else in a picture could be the answer to an indirect task, and no thing of another split is seen.
    """
    props: list[Prop | Thing] = []
    if catalogue.props:
        chosen = rng.permutation(len(catalogue.props))[: rng.integers(0, 6)]
        props.extend(catalogue.props[which] for which in chosen)
    others = [
        thing
        for thing in catalogue.split(plan.thing.split)
        if thing.beside and not thing.in_place and thing.kind != plan.thing.kind and plan.task.direct
    ]
    if others and rng.random() < 0.4:
        props.append(others[rng.integers(len(others))])
    return props


def _draw_surfaces(catalogue: Catalogue, rng: np.random.Generator) -> dict[Use, tuple[str, str]]:
    chosen: dict[Use, tuple[str, str]] = {}
    for use in USES:
        if pictures := catalogue.pictures(use):
            chosen[use] = pictures[rng.integers(len(pictures))]
    return chosen


def _number(scene: Scene, ids: np.ndarray) -> np.ndarray:
    """Geom ids (H, W) as region numbers (H, W) uint8: parts from 1 in the task's order, 0 elsewhere."""
    numbers = np.zeros(scene.model.ngeom + 1, np.uint8)  # the last entry is for id -1: nothing
    for number, geoms in enumerate(scene.part_geoms.values(), start=1):
        numbers[geoms] = number
    return numbers[ids]


def _count(scene: Scene, regions: np.ndarray) -> np.ndarray:
    """Pixels of each part, (parts,)."""
    return np.bincount(regions.ravel(), minlength=len(scene.part_geoms) + 1)[1:]
