"""Putting things where they belong in a compiled scene, by their bounding boxes, and telling their geoms apart."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from a4agent.errors import DataError
from a4agent.sim.backend import mujoco
from a4agent.sim.catalogue import Arm, Model, Selector

SOLID, CLEAR, UNSEEN, PART = 0, 3, 4, 5
"""The geom groups after `sort_geoms`: what the renderer switches on and off."""
A_HAIR = 0.0004


def match_geoms(model: Any, among: Iterable[int], selectors: Sequence[Selector], prefix: str = "") -> np.ndarray:
    """The ids of the geoms `among` those given that any selector matches; names in the model carry `prefix`."""
    return np.array([geom for geom in among if any(_matches(model, geom, s, prefix) for s in selectors)], int)


def bounds(model: Any, data: Any, geoms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and highest corner (3,) of the bounding box of `geoms`, in metres."""
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    corners = [
        data.geom_xpos[geom] + (model.geom_aabb[geom, :3] + signs * model.geom_aabb[geom, 3:]) @ turn.T
        for geom, turn in ((geom, data.geom_xmat[geom].reshape(3, 3)) for geom in geoms)
    ]
    points = np.concatenate(corners)
    return points.min(0), points.max(0)


def set_joints(model: Any, data: Any, entry: Model, prefix: str, rng: np.random.Generator) -> None:
    """Draw each declared joint from its range. A joint without a name goes by its body's."""
    for name, (low, high) in entry.joints.items():
        joint = mujoco().mj_name2id(model, mujoco().mjtObj.mjOBJ_JOINT, prefix + name)
        if joint < 0:
            body = mujoco().mj_name2id(model, mujoco().mjtObj.mjOBJ_BODY, prefix + name)
            joint = model.body_jntadr[body] if body >= 0 and model.body_jntnum[body] == 1 else -1
        if joint < 0:
            raise DataError(f"{entry.file!r} has no joint {name!r} below {entry.root!r}")
        data.qpos[model.jnt_qposadr[joint]] = rng.uniform(low, high)


def subtree_geoms(model: Any, body_name: str) -> np.ndarray:
    """The ids of all geoms of a body and the bodies below it."""
    root = model.body(body_name).id
    inside = np.zeros(model.nbody, bool)
    inside[root] = True
    for body in range(root + 1, model.nbody):
        inside[body] = inside[model.body_parentid[body]]
    return np.flatnonzero(inside[model.geom_bodyid])


def _alpha(model: Any, geom: int) -> float:
    material = model.geom_matid[geom]
    return float(model.mat_rgba[material, 3] if material >= 0 else model.geom_rgba[geom, 3])


def without_collision_geoms(model: Any, geoms: np.ndarray) -> np.ndarray:
    """Without the collision geoms, which these packages keep in groups above 2 or make clear."""
    return np.array([g for g in geoms if model.geom_group[g] <= 2 and _alpha(model, g) > 0.05], int)


def sort_geoms(model: Any, part: np.ndarray) -> None:
    """Give every geom one of our groups by whether it is seen, clear, or of the asked parts."""
    for geom in range(model.ngeom):
        if model.geom_group[geom] > 2 or _alpha(model, geom) <= 0.05:
            model.geom_group[geom] = UNSEEN
        else:
            model.geom_group[geom] = SOLID if _alpha(model, geom) > 0.6 else CLEAR
    model.geom_group[part] = PART
    # Boxes of one thing may share a plane: the part is a hair larger, so that it is seen there and not chance.
    simple = part[model.geom_type[part] != mujoco().mjtGeom.mjGEOM_MESH]
    model.geom_size[simple] += np.where(model.geom_size[simple] > 0, A_HAIR, 0)


def _matches(model: Any, geom: int, selector: Selector, prefix: str) -> bool:
    kind = int(model.geom_type[geom])
    mesh, material = int(model.geom_dataid[geom]), int(model.geom_matid[geom])
    is_mesh = kind == mujoco().mjtGeom.mjGEOM_MESH
    names: dict[str, str | None] = {
        "body": model.body(model.geom_bodyid[geom]).name.removeprefix(prefix),
        "geom": model.geom(geom).name.removeprefix(prefix),
        "mesh": model.mesh(mesh).name.removeprefix(prefix) if is_mesh and mesh >= 0 else None,
        "material": model.mat(material).name.removeprefix(prefix) if material >= 0 else None,
        "type": mujoco().mjtGeom(kind).name.removeprefix("mjGEOM_").lower(),
    }
    numbers = {
        "rgba": (model.geom_rgba[geom], 0.01),
        "size": (model.geom_size[geom], 0.001),
        "pos": (model.geom_pos[geom], 0.001),
    }
    wanted = {field: getattr(selector, field) for field in selector.model_fields_set}
    return all(
        names[field] == value if field in names else np.allclose(numbers[field][0], value, atol=numbers[field][1])
        for field, value in wanted.items()
    )


def put_down(model: Any, data: Any, holder: str, xy: np.ndarray, level: float = 0.0) -> None:
    """Move a body so that what is seen of it stands on the height `level`, its middle over `xy`."""
    low, high = bounds(model, data, _seen_of(model, holder))
    middle = (low + high) / 2
    model.body(holder).pos += np.array([xy[0] - middle[0], xy[1] - middle[1], level - low[2]])
    mujoco().mj_kinematics(model, data)


def _seen_of(model: Any, body_name: str) -> np.ndarray:
    geoms = subtree_geoms(model, body_name)
    return geoms[model.geom_group[geoms] != UNSEEN]


def place_beside(
    model: Any,
    data: Any,
    holder: str,
    taken: list[tuple[np.ndarray, np.ndarray]],
    rng: np.random.Generator,
    level: float,
) -> bool:
    """Stand the prop on a free spot around the thing; out of sight if there is none or it would dwarf the thing."""
    turn = rng.uniform(0, 2 * np.pi)
    twist = np.array([np.cos(turn / 2), 0, 0, np.sin(turn / 2)])
    turned = np.zeros(4)
    mujoco().mju_mulQuat(turned, twist, model.body(holder).quat)
    model.body(holder).quat = turned
    mujoco().mj_kinematics(model, data)
    low, high = bounds(model, data, _seen_of(model, holder))
    half = (high - low)[:2] / 2
    first_low, first_high = taken[0]
    reach = (first_high - first_low).max() / 2
    tries = 20 if half.max() < 1.5 * reach else 0
    for _ in range(tries):
        angle, away = rng.uniform(0, 2 * np.pi), rng.uniform(0.75, 1.7) * (reach + half.max())
        spot = (first_low + first_high) / 2 + away * np.array([np.cos(angle), np.sin(angle)])
        gap = 0.01
        if all(((spot + half + gap < a) | (spot - half - gap > b)).any() for a, b in taken):
            taken.append((spot - half, spot + half))
            put_down(model, data, holder, spot, level)
            return True
    model.geom_group[_seen_of(model, holder)] = UNSEEN
    return False


def reach_towards(
    model: Any, data: Any, arm: Arm, low: np.ndarray, high: np.ndarray, yaw: float, rng: np.random.Generator
) -> None:
    """Turn the arm about the vertical and move its base so that the hand hangs beside or above the thing."""
    comes_from = yaw + rng.choice([-1, 1]) * rng.uniform(0.5, 1.8)
    turn = comes_from + np.pi
    model.body("arm").quat = [np.cos(turn / 2), 0, 0, np.sin(turn / 2)]
    mujoco().mj_kinematics(model, data)
    angle = comes_from + rng.uniform(-0.6, 0.6)
    aside = rng.uniform(0.3, 0.9) * (high - low)[:2].max() * np.array([np.cos(angle), np.sin(angle)])
    fingers_low, _ = bounds(model, data, _seen_of(model, f"arm/{arm.hand}"))
    hand = data.body(f"arm/{arm.hand}").xpos
    goal = np.array([*((low + high)[:2] / 2 + aside), high[2] + rng.uniform(0.03, 0.2)])
    model.body("arm").pos += goal - np.array([hand[0], hand[1], fingers_low[2]])
