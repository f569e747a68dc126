"""A scene: one thing on a table (or in its own room) with props and a robot arm around it, compiled.

Nothing is simulated: bodies are put where they belong, joints are set, and pictures are taken. So free
joints go, and everything is placed by its bounding box.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from a4agent.errors import DataError
from a4agent.sim.assets import asset_path
from a4agent.sim.backend import mujoco
from a4agent.sim.things import Arm, Catalogue, Model, Prop, Selector, Thing, Use

FREE_JOINT = 0
FIXED_LIGHTS = ("key", "fill", "rim")
EYE = "eye"
TABLE_THICKNESS = 0.04
A_HAIR = 0.0004

# Geom groups after `_sort_geoms`: what the renderer switches on and off.
SOLID, CLEAR, UNSEEN, PART = 0, 3, 4, 5


@dataclass(eq=False)
class Scene:
    """A compiled scene. `part_geoms` maps each asked part to its geom ids; `thing_geoms` are the whole thing's.

    `center` (3,) and `radius` describe the thing's bounding box in metres, `top` is its highest z.
    """

    model: Any
    data: Any
    thing: Thing
    part_geoms: dict[str, np.ndarray]
    thing_geoms: np.ndarray
    props: tuple[str, ...]
    arm: str | None
    center: np.ndarray
    radius: float
    top: float

    def surface_id(self, name: str) -> int:
        """The geom id of "table", "wall" or "floor", -1 where the scene has none of ours."""
        return int(mujoco().mj_name2id(self.model, mujoco().mjtObj.mjOBJ_GEOM, f"stage/{name}"))


def build_scene(
    catalogue: Catalogue,
    thing: Thing,
    parts: Sequence[str],
    *,
    props: Sequence[Prop | Thing] = (),
    arm: Arm | None = None,
    surfaces: Mapping[Use, tuple[str, str]] | None = None,
    yaw: float,
    rng: np.random.Generator,
) -> Scene:
    """Compile `thing` with its surroundings and put everything in its place.

    `yaw` is the direction the camera will look from; an arm comes in from that half. Props that find no
    free spot are left out. Raises DataError if a declaration does not fit its file.
    """
    spec = mujoco().MjSpec() if not thing.in_place else _open(catalogue, thing)
    if thing.in_place:
        _clear_room(spec, thing)
        root = _find_root(spec, thing)
        root_name = root.name = root.name or "thing"
    else:
        root_name = _attach(spec, catalogue, thing, "thing")
    for index, prop in enumerate(props):
        _attach(spec, catalogue, prop, f"prop{index}")
    if arm:
        _attach(spec, catalogue, arm, "arm")
    _add_stage(spec, catalogue, {} if thing.in_place else surfaces or {})
    _drop_unused(spec)
    try:
        model = spec.compile()
    except ValueError as error:
        raise DataError(f"the scene of {thing.name!r} does not compile: {error}") from error
    data = mujoco().MjData(model)

    prefix = "" if thing.in_place else "thing/"
    _set_joints(model, data, thing, prefix, rng)
    for index, prop in enumerate(props):
        _set_joints(model, data, prop, f"prop{index}/", rng)
    if arm:
        _set_joints(model, data, arm, "arm/", rng)

    thing_geoms = _seen(model, _subtree_geoms(model, root_name))
    part_geoms = {name: match_geoms(model, thing_geoms, thing.parts[name].geoms, prefix) for name in parts}
    for name, geoms in part_geoms.items():
        if not len(geoms):
            raise DataError(f"no geom of {thing.name!r} matches its part {name!r}")
    _sort_geoms(model, np.concatenate(list(part_geoms.values())))

    mujoco().mj_forward(model, data)
    if not thing.in_place:
        _put_down(model, data, "thing", np.zeros(2))
    low, high = bounds(model, data, thing_geoms)
    placed: list[str] = []
    taken = [(low[:2], high[:2])]
    for index, prop in enumerate(props):
        if _place_beside(model, data, f"prop{index}", taken, rng, level=low[2]):
            placed.append(prop.name)
    if arm:
        _reach_towards(model, data, arm, low, high, yaw, rng)
    mujoco().mj_forward(model, data)
    return Scene(
        model=model,
        data=data,
        thing=thing,
        part_geoms=part_geoms,
        thing_geoms=thing_geoms,
        props=tuple(placed),
        arm=arm.name if arm else None,
        center=(low + high) / 2,
        radius=float(np.linalg.norm(high - low) / 2),
        top=float(high[2]),
    )


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


# Putting the specification together


def _open(catalogue: Catalogue, entry: Model) -> Any:
    path: Path = asset_path(catalogue, entry.package, entry.file)
    try:
        return mujoco().MjSpec.from_file(str(path))
    except ValueError as error:
        raise DataError(f"mujoco cannot read {str(path)!r}: {error}") from error


def _same_physics(child: Any, spec: Any) -> None:
    """Give the child the parent's physics settings: they do not matter here, and a difference is a warning."""
    for name in (name for name in dir(spec.option) if not name.startswith("_")):
        setattr(child.option, name, getattr(spec.option, name))
    for name in ("memory", "njmax", "nconmax", "nstack", "nuserdata", "nkey"):
        setattr(child, name, getattr(spec, name))
    for name in ("body", "jnt", "geom", "site", "cam", "tendon", "actuator", "sensor"):
        setattr(child, f"nuser_{name}", getattr(spec, f"nuser_{name}"))


def _find_root(spec: Any, entry: Model) -> Any:
    """The body called `entry.root`, else the outermost body that holds a geom or mesh of this name."""
    tops = list(spec.worldbody.bodies)
    if entry.root is None:
        if len(tops) == 1:
            return tops[0]
        raise DataError(f"{entry.file!r} has {len(tops)} bodies in its world: say which one with `root`")
    if (named := spec.body(entry.root)) is not None:
        return named
    for body in tops:
        geoms = body.find_all("geom")
        if any(entry.root in (geom.name, geom.meshname) for geom in geoms):
            return body
    raise DataError(f"{entry.file!r} has no body, geom or mesh {entry.root!r}")


def _attach(spec: Any, catalogue: Catalogue, entry: Model, name: str) -> str:
    """Hang the entry's body under a new body `name` at the origin; returns that name."""
    child = _open(catalogue, entry)
    _same_physics(child, spec)
    root = _find_root(child, entry)
    root.pos = np.zeros(3)
    for joint in root.find_all("joint"):
        if joint.type == FREE_JOINT:
            child.delete(joint)
    for joint in list(root.joints):
        if joint.type == FREE_JOINT:
            child.delete(joint)
    holder = spec.worldbody.add_body(name=name, quat=_quaternion(entry.euler))
    holder.add_frame().attach_body(root, f"{name}/", "")
    return name


def _clear_room(spec: Any, thing: Thing) -> None:
    for light in list(spec.lights):
        spec.delete(light)
    for name in thing.without:
        body = spec.body(name)
        if body is None:
            raise DataError(f"{thing.file!r} has no body {name!r} to leave out")
        while body.parent is not None and body.parent.name != "world":
            body = body.parent
        spec.delete(body)


def _add_stage(spec: Any, catalogue: Catalogue, surfaces: Mapping[Use, tuple[str, str]]) -> None:
    """The camera, three lights and, for a thing of its own, table, wall and floor. Sizes are set later by `looks`."""
    spec.worldbody.add_camera(name=EYE)
    spec.add_texture(
        name="stage/sky",
        type=mujoco().mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco().mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.78, 0.8, 0.82],
        rgb2=[0.45, 0.45, 0.47],
        width=64,
        height=384,
    )
    for name in FIXED_LIGHTS:
        spec.worldbody.add_light(name=f"stage/{name}", type=mujoco().mjtLightType.mjLIGHT_DIRECTIONAL)
    sizes = {"table": (1, 1, TABLE_THICKNESS / 2), "wall": (20, 20, 0.1), "floor": (20, 20, 0.1)}
    for use, (package, file) in surfaces.items():
        path = asset_path(catalogue, package, file)
        texture = spec.add_texture(name=f"stage/{use}", file=str(path), type=mujoco().mjtTexture.mjTEXTURE_2D)
        material = spec.add_material(name=f"stage/{use}", texrepeat=[1, 1], texuniform=True, specular=0.2)
        material.textures[mujoco().mjtTextureRole.mjTEXROLE_RGB] = texture.name
        body = spec.worldbody.add_body(name=f"stage/{use}")
        shape = mujoco().mjtGeom.mjGEOM_BOX if use == "table" else mujoco().mjtGeom.mjGEOM_PLANE
        body.add_geom(name=f"stage/{use}", type=shape, size=sizes[use], material=material.name)
    spec.visual.global_.offwidth = spec.visual.global_.offheight = 1280
    spec.visual.quality.offsamples = 4
    spec.visual.quality.shadowsize = 2048


def _drop_unused(spec: Any) -> None:
    """Attaching a body brings all assets of its file along: keep those that are seen."""
    geoms = list(spec.geoms)
    meshes = {geom.meshname for geom in geoms}
    materials = {geom.material for geom in geoms}
    for mesh in list(spec.meshes):
        if mesh.name not in meshes:
            spec.delete(mesh)
    textures: set[str] = set()
    for material in list(spec.materials):
        if material.name not in materials:
            spec.delete(material)
        else:
            textures.update(name for name in material.textures if name)
    for texture in list(spec.textures):
        if texture.name == "stage/sky":
            continue
        if texture.name not in textures:
            spec.delete(texture)
        elif texture.type == mujoco().mjtTexture.mjTEXTURE_SKYBOX:  # some files wrap their textures in one
            texture.type = mujoco().mjtTexture.mjTEXTURE_CUBE


def _quaternion(euler: tuple[float, float, float]) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_euler("xyz", euler, degrees=True).as_quat()
    return np.array([w, x, y, z])


# After compiling: joints, groups, places


def _set_joints(model: Any, data: Any, entry: Model, prefix: str, rng: np.random.Generator) -> None:
    """Draw each declared joint from its range. A joint without a name goes by its body's."""
    for name, (low, high) in entry.joints.items():
        joint = mujoco().mj_name2id(model, mujoco().mjtObj.mjOBJ_JOINT, prefix + name)
        if joint < 0:
            body = mujoco().mj_name2id(model, mujoco().mjtObj.mjOBJ_BODY, prefix + name)
            joint = model.body_jntadr[body] if body >= 0 and model.body_jntnum[body] == 1 else -1
        if joint < 0:
            raise DataError(f"{entry.file!r} has no joint {name!r} below {entry.root!r}")
        data.qpos[model.jnt_qposadr[joint]] = rng.uniform(low, high)


def _subtree_geoms(model: Any, body_name: str) -> np.ndarray:
    root = model.body(body_name).id
    inside = np.zeros(model.nbody, bool)
    inside[root] = True
    for body in range(root + 1, model.nbody):
        inside[body] = inside[model.body_parentid[body]]
    return np.flatnonzero(inside[model.geom_bodyid])


def _alpha(model: Any, geom: int) -> float:
    material = model.geom_matid[geom]
    return float(model.mat_rgba[material, 3] if material >= 0 else model.geom_rgba[geom, 3])


def _seen(model: Any, geoms: np.ndarray) -> np.ndarray:
    """Without the collision geoms, which these packages keep in groups above 2 or make clear."""
    return np.array([g for g in geoms if model.geom_group[g] <= 2 and _alpha(model, g) > 0.05], int)


def _sort_geoms(model: Any, part: np.ndarray) -> None:
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
    found: dict[str, object] = {
        "body": model.body(model.geom_bodyid[geom]).name.removeprefix(prefix),
        "geom": model.geom(geom).name.removeprefix(prefix),
        "mesh": model.mesh(mesh).name.removeprefix(prefix) if is_mesh and mesh >= 0 else None,
        "material": model.mat(material).name.removeprefix(prefix) if material >= 0 else None,
        "type": mujoco().mjtGeom(kind).name.removeprefix("mjGEOM_").lower(),
        "rgba": tuple(round(float(value), 2) for value in model.geom_rgba[geom]),
        "size": tuple(round(float(value), 3) for value in model.geom_size[geom]),
        "pos": tuple(round(float(value), 3) for value in model.geom_pos[geom]),
    }
    return all(found[field] == getattr(selector, field) for field in selector.model_fields_set)


def _put_down(model: Any, data: Any, holder: str, xy: np.ndarray, level: float = 0.0) -> None:
    low, high = bounds(model, data, _seen_of(model, holder))
    middle = (low + high) / 2
    model.body(holder).pos += np.array([xy[0] - middle[0], xy[1] - middle[1], level - low[2]])
    mujoco().mj_kinematics(model, data)


def _seen_of(model: Any, body_name: str) -> np.ndarray:
    geoms = _subtree_geoms(model, body_name)
    return geoms[model.geom_group[geoms] != UNSEEN]


def _place_beside(
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
    tries = 20 if half.max() < 2.5 * reach else 0
    for _ in range(tries):
        angle, away = rng.uniform(0, 2 * np.pi), rng.uniform(0.75, 1.7) * (reach + half.max())
        spot = (first_low + first_high) / 2 + away * np.array([np.cos(angle), np.sin(angle)])
        gap = 0.01
        if all(((spot + half + gap < a) | (spot - half - gap > b)).any() for a, b in taken):
            taken.append((spot - half, spot + half))
            _put_down(model, data, holder, spot, level)
            return True
    model.geom_group[_seen_of(model, holder)] = UNSEEN
    return False


def _reach_towards(
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
