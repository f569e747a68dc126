"""Everything an answer says about acting, in one value: contacts, and with depth their positions and grasps.

plan = plan_action(affordance, depth=metres, camera=camera)
plan.contacts[0].point_xy, plan.grasps[0].pose
plan.to_dict()                     JSON-safe, as `a4 predict --depth` writes it
draw_plan(photo, plan, camera)     the gripper drawn in
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import ImageDraw
from PIL.Image import Image

from a4agent.acting.contact import Contact, contact_points
from a4agent.acting.grasps import Grasp, GripperSettings, find_grasps
from a4agent.acting.lifting import Intrinsics, project
from a4agent.types import Affordance

CONTACT, GRIPPER, HALO = (255, 61, 127), (0, 188, 212), (16, 18, 24)


@dataclass(frozen=True, eq=False)
class ActionPlan:
    """Contacts and grasps, each best first. `reason` says why there are no grasps, "" if there are some."""

    contacts: tuple[Contact, ...]
    grasps: tuple[Grasp, ...] = ()
    reason: str = ""
    frame_id: str = "camera"

    def to_dict(self) -> dict[str, Any]:
        """JSON-safe: metres in the camera's optical frame (x right, y down, z forward), poses row by row."""
        return {
            "frame_id": self.frame_id,
            "contacts": [
                {
                    "point_xy": _numbers(contact.point_xy, 1),
                    "clearance": round(contact.clearance, 1),
                    "position_xyz": _numbers(contact.position_xyz),
                    "normal_xyz": _numbers(contact.normal_xyz),
                    "approach_xyz": _numbers(contact.approach_xyz),
                    "reachable": contact.reachable,
                    "reason": contact.reason,
                }
                for contact in self.contacts
            ],
            "grasps": [
                {
                    "pose": _numbers(grasp.pose),
                    "width": round(grasp.width, 4),
                    "score": round(grasp.score, 4),
                    "contacts_xy": _numbers(grasp.contacts_xy, 1),
                }
                for grasp in self.grasps
            ],
            "reason": self.reason,
        }


def _numbers(values: np.ndarray | None, digits: int = 4) -> Any:
    return None if values is None else np.round(np.asarray(values, np.float64), digits).tolist()


def plan_action(
    affordance: Affordance,
    *,
    depth: np.ndarray | None = None,
    camera: Intrinsics | None = None,
    gripper: GripperSettings | None = None,
    frame_id: str = "camera",
    count: int = 10,
) -> ActionPlan:
    """The contacts of an answer's mask, and with depth (H, W) in metres and a camera its grasps.

    A hard scene raises no error: what could not be measured is None, with a reason.
    """
    mask = affordance.mask
    if not mask.any():
        return ActionPlan((), reason="no part was found", frame_id=frame_id)
    contacts = contact_points(mask, depth, camera)
    if depth is None or camera is None:
        return ActionPlan(contacts, reason="grasps need a depth image and the camera", frame_id=frame_id)
    if not np.isfinite(depth[mask]).any():
        return ActionPlan(contacts, reason="no depth was measured on the part", frame_id=frame_id)
    grasps = find_grasps(mask, depth, camera, gripper, count=count)
    reason = "" if grasps else "no two sides of the part are opposed, close enough and free beside"
    return ActionPlan(contacts, grasps, reason, frame_id)


def draw_plan(photo: Image, plan: ActionPlan, camera: Intrinsics, *, grasps: int = 3) -> Image:
    """The photograph with the best grasps as grippers (thick for the best) and the contacts as dots."""
    canvas = photo.convert("RGB").copy()
    pen = ImageDraw.Draw(canvas)
    unit = max(round(max(canvas.size) / 320), 1)
    for rank, grasp in reversed(list(enumerate(plan.grasps[:grasps]))):
        lines = [project(line, camera) for line in gripper_lines(grasp)]
        thick = 2 * unit if rank == 0 else unit
        for colour, width in ((HALO, thick + 2 * unit), (GRIPPER, thick)):
            for line in lines:
                pen.line([(float(x), float(y)) for x, y in line], fill=colour, width=width, joint="curve")
    for rank, contact in enumerate(plan.contacts):
        x, y = (float(v) for v in contact.point_xy)
        radius = 3 * unit if rank == 0 else 2 * unit
        pen.ellipse((x - radius - unit, y - radius - unit, x + radius + unit, y + radius + unit), fill=HALO)
        pen.ellipse((x - radius, y - radius, x + radius, y + radius), fill=CONTACT)
    return canvas


def gripper_lines(grasp: Grasp) -> list[np.ndarray]:
    """A fork: two fingers, the bar between them and the wrist; each line (n, 3) in the camera's frame."""
    half, finger, wrist = grasp.width / 2 + 0.006, 0.04, 0.08
    fork = np.array([[-half, 0, 0], [-half, 0, -finger], [half, 0, -finger], [half, 0, 0]])
    stem = np.array([[0, 0, -finger], [0, 0, -wrist]])
    return [line @ grasp.pose[:3, :3].T + grasp.pose[:3, 3] for line in (fork, stem)]
