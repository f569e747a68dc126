"""How a scene looks: colours, light, and where the camera stands. All drawn from one generator."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from typing import Any

import numpy as np

from a4agent.sim.backend import mujoco
from a4agent.sim.catalogue import Thing
from a4agent.sim.placing import bounds
from a4agent.sim.scene import EYE, FIXED_LIGHTS, THICKNESS, Scene

SIZES_WH = ((640, 480), (640, 480), (640, 480), (512, 512), (640, 400), (480, 640))
MARGIN = 1.25
"""Pictures are taken this much wider than they are kept; the kept window is the crop."""


@dataclass(frozen=True, eq=False)
class Camera:
    """Where the picture was taken from, in OpenCV's convention: x right, y down, z into the picture.

    `matrix` (3, 3) projects camera coordinates to pixels of the kept window, (0, 0) being the centre of its
    first pixel; `pose` (4, 4) is camera to world, in metres.
    `window` is left, top, right, bottom of the kept window in the wide picture of size `wide_wh`.
    """

    matrix: np.ndarray
    pose: np.ndarray
    window: tuple[int, int, int, int]
    wide_wh: tuple[int, int]

    def crop(self, image: np.ndarray) -> np.ndarray:
        """The kept window of a wide picture."""
        left, top, right, bottom = self.window
        return image[top:bottom, left:right]


def paint(scene: Scene, rng: np.random.Generator) -> None:
    """Recolour about half of the materials, and the stage; textures shine through."""
    model = scene.model
    for material in range(model.nmat):
        texture = (model.mat_texid[material] >= 0).any()
        name = model.mat(material).name
        if name.startswith("stage/"):
            shade = rng.uniform(0.65, 1.0)
            model.mat_rgba[material, :3] = np.clip(shade * _tint(rng, 0.12), 0, 1)
            if name == "stage/wall":  # a hair from clear: it would shade itself, in stripes, if it threw a shadow
                model.mat_rgba[material, 3] = 0.99
        elif rng.random() < 0.5:
            model.mat_rgba[material, :3] = _tint(rng, 0.25) if texture else _paint_colour(rng)
        model.mat_reflectance[material] = min(model.mat_reflectance[material], 0.1)
        model.mat_emission[material] = min(model.mat_emission[material], 0.1)
        if not name.startswith("stage/"):
            model.mat_specular[material] = rng.uniform(0.1, 0.7)
            model.mat_shininess[material] = rng.uniform(0.1, 0.8)


def furnish(scene: Scene, yaw: float, rng: np.random.Generator) -> None:
    """Size table, wall and floor to the thing and turn them roughly towards a camera at `yaw` (radians)."""
    if not scene.surfaces:
        return
    model, radius = scene.model, scene.radius
    turn = yaw + rng.uniform(-0.6, 0.6)
    towards = np.array([np.cos(turn), np.sin(turn)])
    half = np.array([rng.uniform(3.0, 6.0), rng.uniform(1.8, 3.0)]) * max(radius, 0.12)
    shift = rng.uniform(-0.3, 0.3) * half[1] * towards
    behind = shift - (half[1] * rng.uniform(1.0, 1.6) + THICKNESS / 2) * towards
    below = rng.uniform(2.0, 4.0) * max(radius, 0.25)
    flat = [[-towards[1], -towards[0], 0], [towards[0], -towards[1], 0], [0, 0, 1]]
    upright = [[-towards[1], 0, towards[0]], [towards[0], 0, towards[1]], [0, 1, 0]]
    places = {
        "table": ([*shift, -THICKNESS / 2], flat),
        "wall": ([*behind, 0.0], upright),
        "floor": ([0.0, 0.0, -below], np.eye(3)),
    }
    for use in scene.surfaces:
        body = model.body(f"stage/{use}")
        body.pos, body.quat = places[use][0], _quaternion(np.array(places[use][1], float))
        repeat = 1.0 if use == "table" else 0.6
        model.mat_texrepeat[model.mat(f"stage/{use}").id] = repeat * rng.uniform(0.5, 1.5) / max(radius, 0.15) / 3
    if "table" in scene.surfaces:
        table = model.geom("stage/table").id
        model.geom_size[table, :2] = model.geom_aabb[table, 3:5] = half
        model.geom_rbound[table] = np.linalg.norm(model.geom_size[table])


def light(scene: Scene, yaw: float, rng: np.random.Generator) -> None:
    """A key light that throws shadows, a fill light from the other side, a rim light, and some from everywhere."""
    model, data = scene.model, scene.data
    extent = 4 * max(scene.radius, 0.15)
    model.stat.extent, model.stat.center[:] = extent, scene.center
    model.vis.map.znear, model.vis.map.zfar = 0.01, 60.0
    model.vis.map.shadowclip, model.vis.map.shadowscale = 1.0, 0.8
    model.vis.map.haze = 0.0
    ambient = rng.uniform(0.28, 0.48)
    model.vis.headlight.ambient[:] = ambient
    model.vis.headlight.diffuse[:] = rng.uniform(0.05, 0.2)
    model.vis.headlight.specular[:] = 0.0
    side = rng.choice([-1, 1])
    angles = {"key": side * rng.uniform(0.3, 1.3), "fill": -side * rng.uniform(0.5, 1.4), "rim": np.pi + rng.normal()}
    powers = {"key": rng.uniform(0.4, 0.75), "fill": rng.uniform(0.08, 0.25), "rim": rng.uniform(0.0, 0.2)}
    for name in FIXED_LIGHTS:
        lamp = model.light(f"stage/{name}").id
        around, up = yaw + angles[name], rng.uniform(0.6, 1.25)
        outward = np.array([np.cos(around) * np.cos(up), np.sin(around) * np.cos(up), np.sin(up)])
        model.light_pos[lamp] = scene.center + 3 * extent * outward
        model.light_dir[lamp] = -outward
        warmth = rng.uniform(-1, 1)
        colour = np.array([1 + 0.08 * warmth, 1.0, 1 - 0.12 * warmth])
        model.light_diffuse[lamp] = np.clip(powers[name] * colour, 0, 1)
        model.light_specular[lamp] = 0.4 * powers[name]
        model.light_ambient[lamp] = 0.0
        model.light_castshadow[lamp] = name == "key"
        model.light_active[lamp] = True
    mujoco().mj_forward(model, data)


def draw_size(rng: np.random.Generator) -> tuple[int, int]:
    """Width and height of the picture to keep."""
    return SIZES_WH[rng.integers(len(SIZES_WH))]


def widen(size_wh: tuple[int, int]) -> tuple[int, int]:
    """The size to render, of which a picture of `size_wh` is cropped."""
    return int(size_wh[0] * MARGIN), int(size_wh[1] * MARGIN)


def aim(scene: Scene, yaw: float, size: tuple[int, int], rng: np.random.Generator) -> Camera:
    """Stand the camera on a shell around the thing, as a robot's head or wrist would, and draw the crop."""
    model = scene.model
    wide = widen(size)
    yaw = yaw + rng.normal(0, 0.1)
    fovy = np.radians(rng.uniform(38, 58))
    elevation = rng.uniform(*np.radians(scene.thing.elevation))
    narrow = np.tan(fovy / 2) / MARGIN * min(1.0, size[0] / size[1])
    centre, radius = _focus(scene, rng)
    distance = radius / narrow * rng.uniform(0.9, 1.8) + 0.3 * radius
    target = centre + rng.normal(0, 0.12, 3) * radius
    outward = np.array([np.cos(yaw) * np.cos(elevation), np.sin(yaw) * np.cos(elevation), np.sin(elevation)])
    eye = target + distance * outward
    roll = np.radians(rng.normal(0, 3) if rng.random() < 0.8 else rng.uniform(-25, 25))
    turn = _look(-outward, roll)
    camera = model.camera(EYE).id
    model.cam_pos[camera] = eye
    model.cam_fovy[camera] = np.degrees(fovy)
    model.cam_quat[camera] = _quaternion(turn @ np.diag([1.0, -1.0, -1.0]))
    mujoco().mj_forward(model, scene.data)

    left = int(rng.integers(0, wide[0] - size[0] + 1))
    top = int(rng.integers(0, wide[1] - size[1] + 1))
    focal = wide[1] / 2 / np.tan(fovy / 2)
    matrix = np.array([[focal, 0, (wide[0] - 1) / 2 - left], [0, focal, (wide[1] - 1) / 2 - top], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, eye
    return Camera(
        matrix=matrix,
        pose=pose,
        window=(left, top, left + size[0], top + size[1]),
        wide_wh=wide,
    )


def _focus(scene: Scene, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """The middle and radius of what the picture is of: from the part with a little around it to the whole thing."""
    low, high = bounds(scene.model, scene.data, np.concatenate(list(scene.part_geoms.values())))
    far = max(scene.radius, scene.thing.surroundings)
    close = min(2.5 * float(np.linalg.norm(high - low) / 2), far)
    zoom = rng.uniform(0, 1)
    return (1 - zoom) * (low + high) / 2 + zoom * scene.center, close ** (1 - zoom) * far**zoom


def draw_yaw(thing: Thing, rng: np.random.Generator) -> float:
    """The direction the camera looks from, in radians: within the thing's `spread` of its `front`."""
    return float(np.radians(thing.front + rng.uniform(-thing.spread, thing.spread)))


def _look(forward: np.ndarray, roll: float) -> np.ndarray:
    """The rotation (3, 3) whose columns are right, down and forward in world coordinates."""
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    return np.stack([c * right + s * down, c * down - s * right, forward], axis=1)


def _quaternion(turn: np.ndarray) -> np.ndarray:
    quaternion = np.zeros(4)
    mujoco().mju_mat2Quat(quaternion, turn.ravel())
    return quaternion


def _tint(rng: np.random.Generator, strength: float) -> np.ndarray:
    return np.array(colorsys.hsv_to_rgb(rng.random(), strength * rng.random(), 1.0))


def _paint_colour(rng: np.random.Generator) -> Any:
    """Mostly what is sold in shops: white, grey, black, wood, then any colour."""
    if rng.random() < 0.45:
        return np.full(3, rng.choice([0.12, 0.3, 0.55, 0.75, 0.9])) * _tint(rng, 0.1)
    return np.array(colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.35, 0.85), rng.uniform(0.4, 0.95)))
