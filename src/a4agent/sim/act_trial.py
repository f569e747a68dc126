"""One trial of a task: the scene, what a camera sees of it, and a robot hand that acts on a contact point.

    with Trial(task, seed=3) as trial:
        view = trial.photograph()                     # image, depth, camera, masks of the part and of the thing
        outcome = trial.act(contact_xyz)              # in the world's frame
        outcome.success, outcome.steps

The hand is Meta-World's: Sawyer's gripper welded to a mocap body that moves at most a centimetre a step, five physics
steps long (`SawyerXYZEnv`: action_scale 1/100, frame_skip 5, 500 steps), inside the same workspace. The controller
knows the contact point and the task's waypoints; it reads no state of the scene but its own fingertips.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np

from a4agent.acting.lifting import Intrinsics
from a4agent.errors import DataError
from a4agent.sim.act_tasks import ActTask
from a4agent.sim.assets import asset_path
from a4agent.sim.backend import mujoco, renderer
from a4agent.sim.catalogue import built_in
from a4agent.sim.placing import subtree_geoms
from a4agent.sim.scene import drop_unused, same_physics

SIZE_WH = (640, 480)
FOVY = 45.0
FRAME_SKIP, MOST_STEPS, STEP, GAIN = 5, 500, 0.01, 10.0
WORKSPACE = np.array([[-0.5, 0.4, 0.05], [0.5, 1.0, 0.5]])
"""Where the hand may go: `hand_low` and `hand_high` of the environments."""
REACH = WORKSPACE - np.array([0.0, 0.0, 0.05])
"""Where its fingertips may go: they are five centimetres below."""
BEYOND = 0.1
"""Metres that a contact may lie beyond that: the hand then goes as far as it can."""
DOWN, TURNED = (1, 0, 1, 0), (1, -1, 1, 1)
"""Attitudes of the hand, fingers down, as quaternions w x y z: they close along y, or along x."""
REST = np.array([0.0, 0.45, 0.42])
CLOSE_ENOUGH = 0.012
FRAME_EVERY = 8
SETTLE, CLOSING = 20, 25
"""Steps in which a loose thing comes to rest, and in which the fingers close."""
FIRST_JOINT = 9
"""Where the thing's joint is in qpos: behind the arm's seven and the fingers' two."""
PATIENCE = 25
"""Steps without coming nearer after which a waypoint counts as reached: something is in the way."""


@dataclass(frozen=True, eq=False)
class View:
    """What the camera sees: `image` (H, W, 3) uint8, `depth` (H, W) float32 metres, masks (H, W) bool.

    `pose` (4, 4) is camera to world, in OpenCV's convention.
    """

    image: np.ndarray
    depth: np.ndarray
    camera: Intrinsics
    pose: np.ndarray
    part: np.ndarray
    thing: np.ndarray

    def to_world(self, point_xyz: np.ndarray) -> np.ndarray:
        """A point (3,) of the camera's frame in the world's."""
        return self.pose[:3, :3] @ point_xyz + self.pose[:3, 3]


@dataclass(frozen=True)
class Outcome:
    """Whether the environment's test held at any step, and after how many steps the trial ended."""

    success: bool
    steps: int


def load_scene(task: ActTask) -> Any:
    """The compiled model of a task's scene: Meta-World's own, or one of its scenes with a thing of another package.

    Raises:
        MissingExtraError: mujoco or an asset package is not installed.
        DataError: a file of a package does not hold what the task says.
    """
    path = str(asset_path(built_in(), "metaworld", f"sawyer_xyz/{task.model}"))
    if task.guest is None:
        return mujoco().MjModel.from_xml_path(path)
    guest = task.guest
    spec = mujoco().MjSpec.from_file(path)
    child = mujoco().MjSpec.from_file(str(asset_path(built_in(), guest.package, guest.file)))
    host, root = spec.body(guest.instead_of), child.body(guest.root)
    if host is None or root is None:
        raise DataError(
            f"{task.name!r} needs a body {guest.instead_of!r} in {task.model!r} and {guest.root!r} in {guest.file!r}"
        )
    spec.delete(host)
    same_physics(child, spec)
    root.pos = np.zeros(3)
    spec.worldbody.add_body(name=task.thing).add_frame().attach_body(root, f"{task.thing}/", "")
    drop_unused(spec, f"{task.thing}/")
    return spec.compile()


class Trial:
    """A task with its thing placed by a seed. Use it as a context manager, or call `close`."""

    def __init__(self, task: ActTask, seed: int) -> None:
        self.task = task
        self._rng = np.random.default_rng([seed, *task.name.encode()])
        self.model: Any = load_scene(task)
        self.data: Any = mujoco().MjData(self.model)
        self._free_weld()
        self.at = self._rng.uniform(task.low, task.high)
        self._arm = subtree_geoms(self.model, "base")
        self.reset()

    def __enter__(self) -> Trial:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        del self.model, self.data

    def reset(self) -> None:
        """Put the thing in its place and the hand at rest."""
        model, data = self.model, self.data
        mujoco().mj_resetData(model, data)
        self._move_hand(REST, -1.0, 50)
        if self.task.place:
            self.task.place(model, data, self.at)
        else:
            model.body(self.task.thing).pos = self.at
        if self.task.start is not None:
            data.qpos[FIRST_JOINT] = self.task.start
            data.qvel[FIRST_JOINT] = 0
        mujoco().mj_forward(model, data)
        if self.task.grasp is not None:
            self._move_hand(REST, -1.0, SETTLE)

    @property
    def done(self) -> bool:
        """The environment's own success test."""
        return self.task.success(self.model, self.data, self.at)

    def photograph(self) -> View:
        """A picture from in front of the thing, as a camera on the robot's head sees it, without its own arm."""
        self.model.vis.global_.fovy = FOVY
        camera = mujoco().MjvCamera()
        low, high = self._bounds()
        camera.lookat[:] = (low + high) / 2 + self._rng.normal(0, 0.01, 3)
        camera.distance = max(float(np.linalg.norm(high - low)), 0.25) * self._rng.uniform(1.9, 2.5)
        camera.azimuth = 90 + self._rng.uniform(-30, 30)
        camera.elevation = -self._rng.uniform(20, 40)
        with renderer(self.model, SIZE_WH) as rendering:
            image = self._render(rendering, camera)
            rendering.enable_depth_rendering()
            depth = self._render(rendering, camera).astype(np.float32)
            rendering.disable_depth_rendering()
            rendering.enable_segmentation_rendering()
            ids = self._render(rendering, camera)[..., 0]
        thing = subtree_geoms(self.model, self.task.thing)
        part = [geom for geom in thing if self._is_part(int(geom))]
        if not part:
            raise DataError(f"no geom of {self.task.model!r} matches the part {self.task.part!r} of {self.task.name!r}")
        focal = SIZE_WH[1] / 2 / np.tan(np.radians(FOVY) / 2)
        intrinsics = Intrinsics(focal, focal, (SIZE_WH[0] - 1) / 2, (SIZE_WH[1] - 1) / 2)
        return View(image, depth, intrinsics, _pose(camera), np.isin(ids, part), np.isin(ids, thing))

    def act(self, contact_xyz: np.ndarray, on_step: Callable[[], None] | None = None) -> Outcome:
        """Reach for the contact (3,) in the world's frame and follow the task's waypoints until it is done.

        The hand does not move for a contact that is out of its reach.

        `on_step` is called after every FRAME_EVERY steps and at the end, for pictures of what happens.
        """
        within_reach = ((contact_xyz >= REACH[0] - BEYOND) & (contact_xyz <= REACH[1] + BEYOND)).all()
        outcome = self._act(contact_xyz, on_step) if within_reach else Outcome(False, 0)
        if on_step:
            on_step()
        return outcome

    def _act(self, contact_xyz: np.ndarray, on_step: Callable[[], None] | None) -> Outcome:
        steps = 0
        grasp = -1 if self.task.grasp is None else self.task.grasp
        for number, offset in enumerate(self.task.waypoints):
            target = np.clip(contact_xyz + np.array(offset), *REACH)
            nearest, waited, closing = np.inf, 0, 0
            while steps < MOST_STEPS:
                away = target - self._fingertips()
                distance = float(np.linalg.norm(away))
                if distance < CLOSE_ENOUGH or waited > PATIENCE or closing:
                    closing += 1
                    if number != grasp or closing > CLOSING:
                        break
                nearest, waited = (distance, 0) if distance < nearest - 0.001 else (nearest, waited + 1)
                self._step_hand(away, 1.0 if number > grasp or closing else -1.0)
                steps += 1
                if on_step and steps % FRAME_EVERY == 0:
                    on_step()
                if self.done:
                    return Outcome(True, steps)
        return Outcome(False, steps)

    def frame(self, rendering: Any) -> np.ndarray:
        """A picture (H, W, 3) of the scene and the arm from the side, by an open renderer."""
        camera = mujoco().MjvCamera()
        camera.lookat[:] = [self.at[0], 0.75, 0.15]
        camera.distance, camera.azimuth, camera.elevation = 1.3, 140, -25
        rendering.update_scene(self.data, camera, _options())
        for flag in (mujoco().mjtRndFlag.mjRND_SHADOW, mujoco().mjtRndFlag.mjRND_REFLECTION):
            rendering.scene.flags[flag] = 0  # both cost more than the rest of a small picture
        return np.array(rendering.render())

    def _render(self, rendering: Any, camera: Any) -> np.ndarray:
        """A rendering without the arm: its geoms are moved to a group that is not drawn."""
        groups = self.model.geom_group.copy()
        self.model.geom_group[self._arm] = 5
        rendering.update_scene(self.data, camera, _options())
        picture = np.array(rendering.render())
        self.model.geom_group[:] = groups
        return picture

    def _is_part(self, geom: int) -> bool:
        """Whether a drawn geom is named in `part`: by its name, its mesh, or "body:material"."""
        model = self.model
        if model.geom_group[geom] > 2:
            return False
        names = {model.geom(geom).name}
        if model.geom_type[geom] == mujoco().mjtGeom.mjGEOM_MESH:
            names.add(model.mesh(model.geom_dataid[geom]).name)
        body = model.body(model.geom_bodyid[geom]).name or self.task.thing
        if model.geom_matid[geom] >= 0:
            names.add(f"{body}:{model.mat(model.geom_matid[geom]).name}")
        return bool(names & set(self.task.part))

    def _bounds(self) -> tuple[np.ndarray, np.ndarray]:
        drawn = [geom for geom in subtree_geoms(self.model, self.task.thing) if self.model.geom_group[geom] <= 2]
        centres = np.array([self.data.geom_xpos[geom] for geom in drawn])
        radii = np.array([self.model.geom_rbound[geom] for geom in drawn])[:, None] * 0.7
        return (centres - radii).min(0), (centres + radii).max(0)

    def _fingertips(self) -> np.ndarray:
        return (self.data.site("rightEndEffector").xpos + self.data.site("leftEndEffector").xpos) / 2

    def _free_weld(self) -> None:
        """`reset_mocap_welds`: the hand follows the mocap body itself, not a pose relative to it."""
        model = self.model
        for i in range(model.neq):
            if model.eq_type[i] == mujoco().mjtEq.mjEQ_WELD:
                model.eq_data[i, :11] = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 5.0]

    def _step_hand(self, away: np.ndarray, closed: float) -> None:
        move = np.clip(GAIN * away, -1, 1) * STEP
        self._move_hand(np.clip(self.data.mocap_pos[0] + move, *WORKSPACE), closed, 1)

    def _move_hand(self, position: np.ndarray, closed: float, steps: int) -> None:
        for _ in range(steps):
            self.data.mocap_pos[0] = position
            self.data.mocap_quat[0] = TURNED if self.task.turned else DOWN
            self.data.ctrl[:2] = [closed, -closed]
            mujoco().mj_step(self.model, self.data, nstep=FRAME_SKIP)


def _options() -> Any:
    options = mujoco().MjvOption()
    options.sitegroup[:] = 0
    options.geomgroup[:] = [1, 1, 1, 0, 0, 0]
    return options


def _pose(camera: Any) -> np.ndarray:
    """Camera to world (4, 4) of a free camera, in OpenCV's convention."""
    azimuth, elevation = np.radians(camera.azimuth), np.radians(camera.elevation)
    forward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.cross(forward, [0, 0, 1])
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = np.asarray(camera.lookat) - camera.distance * forward
    return pose
