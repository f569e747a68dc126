"""A scene: one thing on a table (or in its own room) with props and a robot arm around it, compiled.

Nothing is simulated: bodies are put where they belong, joints are set, and pictures are taken. So free
joints go, and everything is placed by its bounding box.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from a4agent.errors import DataError
from a4agent.sim.assets import asset_path
from a4agent.sim.backend import mujoco
from a4agent.sim.catalogue import Arm, Catalogue, Model, Prop, Thing, Use
from a4agent.sim.placing import (
    bounds,
    match_geoms,
    place_beside,
    put_down,
    reach_towards,
    set_joints,
    sort_geoms,
    subtree_geoms,
    without_collision_geoms,
)

FREE_JOINT = 0
FIXED_LIGHTS = ("key", "fill", "rim")
EYE = "eye"
THICKNESS = 0.04


@dataclass(eq=False)
class Scene:
    """A compiled scene. `part_geoms` maps each asked part to its geom ids; `thing_geoms` are the whole thing's.

    `arm_geoms` are the robot's, `surfaces` those of our stage. `center` (3,) and `radius` describe the
    thing's bounding box in metres.
    """

    model: Any
    data: Any
    thing: Thing
    part_geoms: dict[str, np.ndarray]
    thing_geoms: np.ndarray
    arm_geoms: np.ndarray
    surfaces: tuple[Use, ...]
    props: tuple[str, ...]
    arm: str | None
    center: np.ndarray
    radius: float


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
    surfaces = {} if thing.in_place else surfaces or {}
    model, root_name = _compile(catalogue, thing, props, arm, surfaces)
    data = mujoco().MjData(model)

    prefix = "" if thing.in_place else "thing/"
    set_joints(model, data, thing, prefix, rng)
    for index, prop in enumerate(props):
        set_joints(model, data, prop, f"prop{index}/", rng)
    if arm:
        set_joints(model, data, arm, "arm/", rng)

    thing_geoms = without_collision_geoms(model, subtree_geoms(model, root_name))
    part_geoms = {name: match_geoms(model, thing_geoms, thing.parts[name].geoms, prefix) for name in parts}
    for name, geoms in part_geoms.items():
        if not len(geoms):
            raise DataError(f"no geom of {thing.name!r} matches its part {name!r}")
    sort_geoms(model, np.concatenate(list(part_geoms.values())))

    mujoco().mj_forward(model, data)
    if not thing.in_place:
        put_down(model, data, "thing", np.zeros(2))
    low, high = bounds(model, data, thing_geoms)
    placed: list[str] = []
    taken = [(low[:2], high[:2])]
    for index, prop in enumerate(props):
        if place_beside(model, data, f"prop{index}", taken, rng, level=low[2]):
            placed.append(prop.name)
    if arm:
        reach_towards(model, data, arm, low, high, yaw, rng)
    mujoco().mj_forward(model, data)
    return Scene(
        model=model,
        data=data,
        thing=thing,
        part_geoms=part_geoms,
        thing_geoms=thing_geoms,
        arm_geoms=subtree_geoms(model, "arm") if arm else np.zeros(0, int),
        surfaces=tuple(surfaces),
        props=tuple(placed),
        arm=arm.name if arm else None,
        center=(low + high) / 2,
        radius=float(np.linalg.norm(high - low) / 2),
    )


def _compile(
    catalogue: Catalogue,
    thing: Thing,
    props: Sequence[Prop | Thing],
    arm: Arm | None,
    surfaces: Mapping[Use, tuple[str, str]],
) -> tuple[Any, str]:
    """The model of everything, not yet in its place, and the name of the thing's body in it."""
    spec, root_name = _start(catalogue, thing)
    for index, prop in enumerate(props):
        _attach(spec, catalogue, prop, f"prop{index}")
    if arm:
        _attach(spec, catalogue, arm, "arm")
    _add_stage(spec, catalogue, surfaces)
    drop_unused(spec)
    try:
        return spec.compile(), root_name
    except ValueError as error:
        raise DataError(f"the scene of {thing.name!r} does not compile: {error}") from error


def _start(catalogue: Catalogue, thing: Thing) -> tuple[Any, str]:
    """The specification that all else is added to, and the name of the thing's body in it."""
    if not thing.in_place:
        spec = mujoco().MjSpec()
        return spec, _attach(spec, catalogue, thing, "thing")
    spec = _open(catalogue, thing)
    _clear_room(spec, thing)
    root = _find_root(spec, thing)
    root.name = root.name or "thing"
    return spec, root.name


def _open(catalogue: Catalogue, entry: Model) -> Any:
    path: Path = asset_path(catalogue, entry.package, entry.file)
    try:
        return mujoco().MjSpec.from_file(str(path))
    except ValueError as error:
        raise DataError(f"mujoco cannot read {str(path)!r}: {error}") from error


def same_physics(child: Any, spec: Any) -> None:
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
    same_physics(child, spec)
    root = _find_root(child, entry)
    root.pos = np.zeros(3)
    for joint in list(root.find_all("joint")):
        if joint.type == FREE_JOINT:
            child.delete(joint)
    holder = spec.worldbody.add_body(name=name, quat=_quaternion(entry.euler))
    holder.add_frame().attach_body(root, f"{name}/", "")
    return name


def _clear_room(spec: Any, thing: Thing) -> None:
    """Take out the room's own lights, and what the thing is declared to be shown `without`."""
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
    """The camera, three lights and, for a thing of its own, table, wall and floor. `appearance` sizes them."""
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
    box = mujoco().mjtGeom.mjGEOM_BOX  # not planes: they would shade themselves
    for use, (package, file) in surfaces.items():
        path = asset_path(catalogue, package, file)
        texture = spec.add_texture(name=f"stage/{use}", file=str(path), type=mujoco().mjtTexture.mjTEXTURE_2D)
        material = spec.add_material(name=f"stage/{use}", texrepeat=[1, 1], texuniform=True, specular=0.2)
        material.textures[mujoco().mjtTextureRole.mjTEXROLE_RGB] = texture.name
        body = spec.worldbody.add_body(name=f"stage/{use}")
        half = (1, 1, THICKNESS / 2) if use == "table" else (20, 20, THICKNESS / 2)
        body.add_geom(name=f"stage/{use}", type=box, size=half, material=material.name)
    spec.visual.global_.offwidth = spec.visual.global_.offheight = 1280
    spec.visual.quality.offsamples = 4
    spec.visual.quality.shadowsize = 2048


def drop_unused(spec: Any, prefix: str = "") -> None:
    """Attaching a body brings all assets of its file along: of those named `prefix`..., keep those that are seen."""
    geoms = list(spec.geoms)
    meshes = {geom.meshname for geom in geoms}
    materials = {geom.material for geom in geoms}
    for mesh in list(spec.meshes):
        if mesh.name.startswith(prefix) and mesh.name not in meshes:
            spec.delete(mesh)
    textures: set[str] = set()
    for material in list(spec.materials):
        if material.name.startswith(prefix) and material.name not in materials:
            spec.delete(material)
        else:
            textures.update(name for name in material.textures if name)
    for texture in list(spec.textures):
        if texture.name == "stage/sky" or not texture.name.startswith(prefix):
            continue
        if texture.name not in textures:
            spec.delete(texture)
        elif texture.type == mujoco().mjtTexture.mjTEXTURE_SKYBOX:  # some files wrap their textures in one
            texture.type = mujoco().mjtTexture.mjTEXTURE_CUBE


def _quaternion(euler: tuple[float, float, float]) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_euler("xyz", euler, degrees=True).as_quat()
    return np.array([w, x, y, z])
