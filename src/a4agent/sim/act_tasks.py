"""The tasks of `sim-act`: Meta-World's scenes, their published placement and success tests, and one skill each.

Meta-World's Python environments need packages that this project leaves out, so its MJCF files are read as data and
what an environment adds to them is restated here: where its thing is put (`low`, `high`: its `_random_reset_space`),
how its joint starts (`reset_model`) and when it counts as done (`success`, from `evaluate_state`). The source of each
is `metaworld/envs/sawyer_<source>_v3.py` of metaworld 3.1.1, by Farama Foundation, MIT. The microwave and its test are
those of gymnasium-robotics 1.4.2 (the kitchen: Apache-2.0); it stands where we put it.

A skill is what a robot knows of the verb in the sentence, not of the scene: waypoints of its fingertips relative to
the contact point, in the world's frame (x right, y away from the robot, z up). The fingers are closed, or close at
one waypoint: along y (along x with the hand turned), and no wider than ten centimetres.

Where a task has a second place that no contact tells (the box of `box_close`, the nail of `hammer`), what counts is
the environment's own word for a thing that is picked up (`pickCompleted`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

TARGET_RADIUS = 0.05
"""`SawyerXYZEnv.TARGET_RADIUS`."""

KITCHEN = "kitchen_franka/kitchen_assets/kitchen_env_model.xml"

Waypoint = tuple[float, float, float]
Success = Callable[[Any, Any, np.ndarray], bool]
"""(model, data, where the thing was put (3,)) -> whether the environment counts the task as done."""
Placement = Callable[[Any, Any, np.ndarray], None]
"""(model, data, where the thing is to be put (3,)): puts it there."""


@dataclass(frozen=True)
class Guest:
    """The body `root` of a file of another package, put into the scene for its body `instead_of`."""

    package: str
    file: str
    root: str
    instead_of: str


@dataclass(frozen=True)
class ActTask:
    """One task. `part` are the names of geoms or meshes of the true part, `thing` the body of the whole object.

    `place` puts the thing down (None: moves its body), `start` is the joint's first position (None: as in the file).
    With `grasp` the fingers are open up to the waypoint of this number, close there and stay closed; without it they
    are closed all the time. The hand is `turned` a quarter about the vertical where they must close along x.
    """

    name: str
    source: str
    model: str
    thing: str
    part: tuple[str, ...]
    low: Waypoint
    high: Waypoint
    sentences: tuple[str, ...]
    object_name: str
    object_part: str
    waypoints: tuple[Waypoint, ...]
    success: Success
    place: Placement | None = None
    start: float | None = None
    grasp: int | None = None
    turned: bool = False
    guest: Guest | None = None


def _xyz(x: float, y: float, z: float) -> np.ndarray:
    return np.array([x, y, z])


def _norm(offset: Any) -> float:
    return float(np.linalg.norm(offset))


def _drawer(data: Any) -> np.ndarray:
    return np.asarray(data.body("drawer_link").xpos) + _xyz(0.0, -0.16, 0.0)


def _site(data: Any, name: str) -> np.ndarray:
    return np.asarray(data.site(name).xpos)


def _put_free(joint: int = 9) -> Placement:
    """A thing with a free joint, whose position is in qpos from `joint` on."""

    def put(model: Any, data: Any, at: np.ndarray) -> None:
        data.qpos[joint : joint + 3] = at

    return put


def _put_ring(model: Any, data: Any, at: np.ndarray) -> None:
    model.body("peg").pos = at + _xyz(0, 0, 0.03)
    data.qpos[9:12] = at


def _put_plug(model: Any, data: Any, at: np.ndarray) -> None:
    model.body("box").pos = at
    data.qpos[9:12] = at + _xyz(0.044, 0, 0.131)


def _put_coffee_machine(model: Any, data: Any, at: np.ndarray) -> None:
    model.body("coffee_machine").pos = at
    data.qpos[0:3] = at + _xyz(0, -0.22, 0)  # the mug below the spout


TASKS = (
    ActTask(
        name="drawer-open",
        source="drawer_open",
        model="sawyer_drawer.xml",
        thing="drawer",
        part=("objGeom",),
        low=(-0.1, 0.9, 0.0),
        high=(0.1, 0.9, 0.0),
        sentences=("Open the drawer.", "Pull the drawer open by its handle."),
        object_name="drawer",
        object_part="the handle of the drawer",
        waypoints=((0, 0.035, 0.12), (0, 0.035, -0.01), (0, -0.25, -0.01)),
        success=lambda m, d, at: _norm(_drawer(d) - (at + _xyz(0, -0.36, 0.09))) <= 0.03,
    ),
    ActTask(
        name="drawer-close",
        source="drawer_close",
        model="sawyer_drawer.xml",
        thing="drawer",
        part=("objGeom", "drawer"),
        low=(-0.1, 0.9, 0.0),
        high=(0.1, 0.9, 0.0),
        sentences=("Close the drawer.", "Push the drawer shut."),
        object_name="drawer",
        object_part="the front of the drawer",
        waypoints=((0, -0.1, 0.12), (0, -0.1, 0), (0, 0.3, 0)),
        success=lambda m, d, at: _norm(_drawer(d) - (at + _xyz(0, -0.16, 0.04))) <= TARGET_RADIUS + 0.015,
        start=-0.15,
    ),
    ActTask(
        name="door-open",
        source="door",
        model="sawyer_door_pull.xml",
        thing="door",
        part=("handle", "handle_base"),
        low=(0.0, 0.85, 0.15),
        high=(0.1, 0.95, 0.15),
        sentences=("Open the door of the safe.", "Pull the safe open by its handle."),
        object_name="safe",
        object_part="the handle of the safe",
        waypoints=((0, 0.05, 0.12), (0, 0.05, -0.01), (-0.1, -0.12, -0.01), (-0.3, -0.25, -0.01), (-0.45, -0.2, -0.01)),
        success=lambda m, d, at: abs(float(d.geom("handle").xpos[0]) - (at[0] - 0.3)) <= 0.08,
    ),
    ActTask(
        name="door-close",
        source="door_close",
        model="sawyer_door_pull.xml",
        thing="door",
        part=("handle", "handle_base", "door"),
        low=(0.0, 0.85, 0.15),
        high=(0.1, 0.95, 0.15),
        sentences=("Close the door of the safe.", "Push the safe shut."),
        object_name="safe",
        object_part="the door of the safe",
        waypoints=((-0.12, 0, 0.15), (-0.12, 0, 0), (0.15, 0.08, 0), (0.35, 0.2, 0), (0.5, 0.4, 0)),
        success=lambda m, d, at: _norm(d.geom("handle").xpos - (at + _xyz(0.2, -0.2, 0))) <= 0.08,
        start=-1.5708,
    ),
    ActTask(
        name="window-open",
        source="window_open",
        model="sawyer_window_horizontal.xml",
        thing="window",
        part=("windowb_a:window_white",),
        low=(-0.1, 0.7, 0.16),
        high=(0.1, 0.9, 0.16),
        sentences=("Open the sliding window.", "Slide the window open by its handle."),
        object_name="window",
        object_part="the handle of the window",
        waypoints=((-0.07, 0.008, 0.16), (-0.07, 0.008, 0), (0.3, 0.008, 0)),
        success=lambda m, d, at: abs(_site(d, "handleOpenStart")[0] - (at[0] + 0.2)) <= TARGET_RADIUS,
        start=0.0,
    ),
    ActTask(
        name="window-close",
        source="window_close",
        model="sawyer_window_horizontal.xml",
        thing="window",
        part=("windowb_a:window_white",),
        low=(0.0, 0.75, 0.2),
        high=(0.0, 0.9, 0.2),
        sentences=("Close the sliding window.", "Slide the window shut by its handle."),
        object_name="window",
        object_part="the handle of the window",
        waypoints=((0.07, -0.02, 0.16), (0.07, -0.02, 0), (-0.3, -0.02, 0)),
        success=lambda m, d, at: abs(_site(d, "handleCloseStart")[0] - at[0]) <= TARGET_RADIUS,
        start=0.2,
    ),
    ActTask(
        name="button-press",
        source="button_press",
        model="sawyer_button_press.xml",
        thing="box",
        part=("btnGeom",),
        low=(-0.1, 0.85, 0.115),
        high=(0.1, 0.9, 0.115),
        sentences=("Press the red button.", "Push the button in."),
        object_name="button box",
        object_part="the button of the button box",
        waypoints=((0, -0.1, 0), (0, 0.2, 0)),
        success=lambda m, d, at: abs(_site(d, "hole")[1] - (float(d.body("button").xpos[1]) - 0.193)) <= 0.02,
        start=0.0,
    ),
    ActTask(
        name="button-press-topdown",
        source="button_press_topdown",
        model="sawyer_button_press_topdown.xml",
        thing="box",
        part=("btnGeom",),
        low=(-0.1, 0.8, 0.115),
        high=(0.1, 0.9, 0.115),
        sentences=("Press the red button down.", "Push down the button."),
        object_name="button box",
        object_part="the button of the button box",
        waypoints=((0, 0.0, 0.12), (0, 0.0, -0.2)),
        success=lambda m, d, at: abs(_site(d, "hole")[2] - (float(d.body("button").xpos[2]) + 0.193)) <= 0.024,
    ),
    ActTask(
        name="coffee-button",
        source="coffee_button",
        model="sawyer_coffee.xml",
        thing="coffee_machine",
        part=("cmbutton:cmgrey",),
        low=(-0.1, 0.8, -0.001),
        high=(0.1, 0.9, 0.001),
        sentences=("Start the coffee machine.", "Press the button of the coffee machine."),
        object_name="coffee machine",
        object_part="the button of the coffee machine",
        waypoints=((0, -0.1, 0), (0, 0.1, 0)),
        success=lambda m, d, at: abs(at[1] - 0.19 - _site(d, "buttonStart")[1]) <= 0.02,
        place=_put_coffee_machine,
    ),
    ActTask(
        name="faucet-open",
        source="faucet_open",
        model="sawyer_faucet.xml",
        thing="faucetBase",
        part=("faucethandle1", "faucet_link2:faucet_red"),
        low=(-0.05, 0.8, 0.0),
        high=(0.05, 0.85, 0.0),
        sentences=("Turn the tap to the right.", "Open the tap: turn its handle to the right."),
        object_name="tap",
        object_part="the handle of the tap",
        waypoints=((-0.08, 0, 0.12), (-0.08, 0, -0.03), (0.1, 0.04, -0.03), (0.22, 0.14, -0.03)),
        success=lambda m, d, at: _norm(_site(d, "handleStartOpen") - (at + _xyz(0.175, 0, 0.135))) <= 0.07,
    ),
    ActTask(
        name="faucet-close",
        source="faucet_close",
        model="sawyer_faucet.xml",
        thing="faucetBase",
        part=("faucethandle1", "faucet_link2:faucet_red"),
        low=(-0.1, 0.8, 0.0),
        high=(0.1, 0.85, 0.0),
        sentences=("Turn the tap to the left.", "Close the tap: turn its handle to the left."),
        object_name="tap",
        object_part="the handle of the tap",
        waypoints=((0.08, 0, 0.12), (0.08, 0, -0.03), (-0.1, 0.04, -0.03), (-0.22, 0.14, -0.03)),
        success=lambda m, d, at: _norm(_site(d, "handleStartClose") - (at + _xyz(-0.175, 0, 0.135))) <= 0.07,
    ),
    ActTask(
        name="handle-press",
        source="handle_press",
        model="sawyer_handle_press.xml",
        thing="box",
        part=("handle_press_grip",),
        low=(-0.1, 0.8, -0.001),
        high=(0.1, 0.9, 0.001),
        sentences=("Press the red handle down.", "Push the lever down by its grip."),
        object_name="press",
        object_part="the handle of the press",
        waypoints=((0, 0, 0.12), (0, 0, -0.25)),
        success=lambda m, d, at: abs(_site(d, "handleStart")[2] - _site(d, "goalPress")[2]) <= TARGET_RADIUS,
        start=-0.001,
    ),
    ActTask(
        name="door-lock",
        source="door_lock",
        model="sawyer_door_lock.xml",
        thing="door",
        part=("lock_link:dl_metal",),
        low=(-0.1, 0.8, 0.15),
        high=(0.1, 0.85, 0.15),
        sentences=("Lock the safe.", "Turn the lock of the safe down."),
        object_name="safe",
        object_part="the lock of the safe",
        waypoints=((-0.01, -0.01, 0.12), (-0.01, -0.01, -0.06), (-0.05, -0.01, -0.15)),
        success=lambda m, d, at: abs(float(d.body("lock_link").xpos[2]) - 0.1 - _site(d, "lockStartLock")[2]) <= 0.02,
    ),
    ActTask(
        name="handle-pull",
        source="handle_pull",
        model="sawyer_handle_press.xml",
        thing="box",
        part=("handle_press_grip",),
        low=(-0.1, 0.8, -0.001),
        high=(0.1, 0.9, 0.001),
        sentences=("Pull the red handle up.", "Pull the lever up by its grip."),
        object_name="press",
        object_part="the handle of the press",
        waypoints=((-0.066, 0.015, 0.12), *((-0.066, 0.015, -0.06 + 0.013 * i) for i in range(14))),
        success=lambda m, d, at: abs(_site(d, "handleRight")[2] - _site(d, "goalPull")[2]) <= TARGET_RADIUS,
        start=-0.1,
        grasp=1,
    ),
    ActTask(
        name="lid-lift",
        source="box_close",
        model="sawyer_box.xml",
        thing="boxbodytop",
        part=("BoxHandleGeom",),
        low=(-0.05, 0.5, 0.02),
        high=(0.05, 0.55, 0.02),
        sentences=("Lift the lid.", "Pick up the lid by its handle."),
        object_name="lid",
        object_part="the handle of the lid",
        waypoints=((0, 0, 0.12), (0, 0, -0.03), (0, 0, 0.4)),
        success=lambda m, d, at: float(d.body("top_link").xpos[2]) >= at[2] + 0.157 + 0.12 - 0.01,
        place=_put_free(),
        grasp=1,
    ),
    ActTask(
        name="hammer-lift",
        source="hammer",
        model="sawyer_hammer.xml",
        thing="hammerbody",
        part=("HammerHandle",),
        low=(-0.1, 0.4, 0.0),
        high=(0.1, 0.5, 0.0),
        sentences=("Pick up the hammer.", "Pick the hammer up by its handle."),
        object_name="hammer",
        object_part="the handle of the hammer",
        waypoints=((0, 0.015, 0.12), (0, 0.015, -0.06), (0, 0.015, 0.2)),
        success=lambda m, d, at: float(d.body("hammer").xpos[2]) >= at[2] + 0.09 - 0.01,
        place=_put_free(),
        grasp=1,
    ),
    ActTask(
        name="ring-lift",
        source="disassemble_peg",
        model="sawyer_assembly_peg.xml",
        thing="RoundNut",
        part=("WrenchHandle",),
        low=(0.0, 0.6, 0.025),
        high=(0.1, 0.75, 0.02501),
        sentences=("Lift the ring off the peg.", "Take the ring off the peg by its green handle."),
        object_name="ring",
        object_part="the handle of the ring",
        waypoints=((0, 0.015, 0.12), (0, 0.015, -0.06), (0, 0.015, 0.35)),
        success=lambda m, d, at: _site(d, "RoundNut-8")[2] > at[2] + 0.15,
        place=_put_ring,
        grasp=1,
    ),
    ActTask(
        name="plug-pull",
        source="peg_unplug_side",
        model="sawyer_peg_unplug_side.xml",
        thing="plug1",
        part=("plug:plug_black",),
        low=(-0.25, 0.6, -0.001),
        high=(-0.15, 0.8, 0.001),
        sentences=("Unplug it.", "Pull the plug out of the socket by its grip."),
        object_name="plug",
        object_part="the grip of the plug",
        waypoints=((-0.03, 0.035, 0.12), (-0.03, 0.035, -0.04), (0.3, 0.035, -0.04)),
        success=lambda m, d, at: _norm(_site(d, "pegEnd") - (at + _xyz(0.194, 0, 0.131))) <= 0.07,
        place=_put_plug,
        grasp=1,
    ),
    ActTask(
        name="microwave-open",
        source="gymnasium_robotics: envs/franka_kitchen/kitchen_env.py",
        model="sawyer_reach_v3.xml",
        thing="microwave",
        part=("microwave/microdoorroot:microwave/micro_metal",),
        low=(-0.05, 0.93, 0.0),
        high=(0.05, 0.97, 0.0),
        sentences=("Open the microwave.", "Pull the microwave open by its handle."),
        object_name="microwave",
        object_part="the handle of the microwave",
        waypoints=((0, 0.02, 0.25), (0, 0.02, 0.07), (-0.05, -0.115, 0.07), (-0.144, -0.23, 0.07), (-0.22, -0.3, 0.07)),
        success=lambda m, d, at: abs(float(d.qpos[9]) + 0.75) < 0.3,
        start=0.0,
        grasp=1,
        turned=True,
        guest=Guest("gymnasium-robotics", KITCHEN, root="microroot", instead_of="obj"),
    ),
)
"""All tasks, in the order in which they are asked."""
