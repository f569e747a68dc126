"""Log an affordance, and what was lifted from it, to the Rerun viewer.

rr.init("a4agent", spawn=True)
log(affordance)                                   # picture, mask, boxes, points, thinking
log_lifted(lift(affordance, depth, intrinsics))   # clouds, key points, contact frames
log_plan(plan_action(affordance, depth=depth, camera=intrinsics))   # contacts to touch, grippers
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from a4agent.acting.lifting import Lifted
from a4agent.acting.plan import GRIPPER, ActionPlan, gripper_lines
from a4agent.errors import require
from a4agent.types import Affordance

COLOUR = (255, 64, 129)


def log(affordance: Affordance, path: str = "affordance", recording: Any = None) -> None:
    """Log everything 2D below the entity `path`: image, mask, boxes, points, imagination, thinking.

    What an earlier call logged there and this affordance does not have is cleared.

    Raises:
        MissingExtraError: rerun is not installed.
    """
    rr, put = _logger(path, recording)
    put("", rr.Clear(recursive=True))
    imagination = affordance.imagination
    if affordance.image is not None:
        put("image", rr.Image(np.asarray(affordance.image)))
    put("image/mask", rr.SegmentationImage(affordance.mask.astype(np.uint8), opacity=0.5))
    boxes = affordance.boxes_xyxy
    if len(boxes):
        labels = [affordance.phrase] * len(boxes)
        put("image/boxes", rr.Boxes2D(array=boxes, array_format=rr.Box2DFormat.XYXY, labels=labels))
    if len(affordance.points_xy):
        put("image/points", rr.Points2D(affordance.points_xy, radii=4.0, colors=COLOUR))
    if imagination and imagination.image is not None:
        put("imagination", rr.Image(np.asarray(imagination.image.convert("RGB"))))
    put("thinking", rr.TextDocument(_story(affordance)))


def log_lifted(lifted: Lifted, path: str = "affordance/lifted", recording: Any = None) -> None:
    """Log clouds, measured key points and contact frames below the entity `path`.

    Raises:
        MissingExtraError: rerun is not installed.
    """
    rr, put = _logger(path, recording)
    put("", rr.Clear(recursive=True))
    for number, region in enumerate(lifted.regions):
        put(f"{number}/cloud", rr.Points3D(region.cloud_xyz))
        points = region.points_xyz[np.isfinite(region.points_xyz).all(1)]
        put(f"{number}/points", rr.Points3D(points, radii=0.004, colors=COLOUR))
        if region.frame.measured:
            arrows = rr.Arrows3D(
                origins=[region.frame.origin] * 3,
                vectors=region.frame.rotation.T * 0.05,
                colors=[(255, 0, 0), (0, 255, 0), (0, 0, 255)],
            )
            put(f"{number}/frame", arrows)


def log_plan(plan: ActionPlan, path: str = "affordance", recording: Any = None) -> None:
    """Log contacts as points of the picture, and with depth as arrows into the surface, and grasps as grippers.

    Raises:
        MissingExtraError: rerun is not installed.
    """
    rr, put = _logger(path, recording)
    for name in ("image/contacts", "contacts", "grasps"):
        put(name, rr.Clear(recursive=True))
    labels = [str(rank + 1) for rank in range(len(plan.contacts))]
    if plan.contacts:
        points = np.stack([contact.point_xy for contact in plan.contacts])
        put("image/contacts", rr.Points2D(points, radii=6.0, colors=COLOUR, labels=labels))
    measured = [
        (contact.position_xyz, contact.approach_xyz)
        for contact in plan.contacts
        if contact.position_xyz is not None and contact.approach_xyz is not None
    ]
    if measured:
        positions, approaches = (np.stack(vectors) for vectors in zip(*measured, strict=True))
        arrows = rr.Arrows3D(origins=positions - 0.05 * approaches, vectors=0.05 * approaches, colors=COLOUR)
        put("contacts", arrows)
    for rank, grasp in enumerate(plan.grasps):
        put(f"grasps/{rank}", rr.LineStrips3D(gripper_lines(grasp), radii=0.001, colors=GRIPPER))


def _logger(path: str, recording: Any) -> tuple[Any, Callable[[str, Any], None]]:
    """The library, and a function that logs a value below the entity `path`."""
    rr = require("rerun", extra="rerun")
    return rr, lambda name, value: rr.log(f"{path}/{name}", value, recording=recording)


def _story(affordance: Affordance) -> str:
    target = affordance.target
    lines = [f"instruction: {affordance.instruction}", f"status: {affordance.status}"]
    if target:
        lines += [f"part: {target.object_part}", "", target.thinking]
    if affordance.error:
        lines += ["", affordance.error]
    return "\n".join(lines)
