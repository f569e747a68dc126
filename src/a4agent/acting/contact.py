"""Where to touch a part: points deep inside its mask, on its surface, that the camera sees.

    contacts = contact_points(affordance.mask, depth, camera)
    contacts[0].point_xy              (2,) pixels, the farthest from the mask's edge
    contacts[0].position_xyz          (3,) metres in the camera's optical frame, None if it was not measured
    contacts[0].reason                "" or why there is no position: "no depth was measured there"

The first point is the pole of inaccessibility, the centre of the largest circle inside the mask. The next ones are
the centres of the largest circles that keep clear of those before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from a4agent.acting.lifting import Intrinsics, back_project
from a4agent.imaging.masks import tight_box

PATCH_PIXELS = 6
"""The surface around a contact is fitted to the measured pixels of the mask within this distance, and 15 mm."""
PATCH_METRES = 0.015
LEAST_PIXELS = 12
FACING = 0.2
"""A surface whose normal and view ray have a smaller cosine is seen edge-on: its depth is unreliable."""
BEHIND = 0.03
"""Metres that a contact may lie behind the nearest part of its patch; more is another surface seen through a gap."""


@dataclass(frozen=True, eq=False)
class Contact:
    """A place to touch. `clearance` is in pixels from the mask's edge.

    `position_xyz`, `normal_xyz` (unit, towards the camera) and `approach_xyz` (unit, into the surface) are (3,) in the
    camera's optical frame, metres; None with a `reason` where depth does not give them. `reachable` is False for a
    surface that is seen edge-on or through a gap.
    """

    point_xy: np.ndarray
    clearance: float
    position_xyz: np.ndarray | None = None
    normal_xyz: np.ndarray | None = None
    approach_xyz: np.ndarray | None = None
    reachable: bool = True
    reason: str = ""


def contact_points(
    mask: np.ndarray, depth: np.ndarray | None = None, camera: Intrinsics | None = None, *, count: int = 3
) -> tuple[Contact, ...]:
    """Up to `count` contacts, best first; none for a blank mask.

    Reachable and measured contacts come before others, those with more clearance before those with less.

    Args:
        mask: (H, W) bool.
        depth: (H, W) metres along the camera's axis, NaN where not measured (`lifting.metres_of`).
        camera: its intrinsics; needed with `depth`.
    """
    from scipy.ndimage import distance_transform_edt

    box = tight_box(mask)
    if box is None:
        return ()
    left, top, right, bottom = (int(edge) for edge in box)
    inside = mask[top:bottom, left:right]
    room = np.asarray(distance_transform_edt(np.pad(inside, 1)))[1:-1, 1:-1]
    rows, columns = np.indices(inside.shape)
    found: list[Contact] = []
    centre = np.argwhere(inside).mean(0)
    while len(found) < count and room.max(initial=0.0) > 0:
        deepest = np.argwhere(room >= room.max() - 0.5)  # along a bar many are as deep: take the middle one
        row, column = (int(i) for i in deepest[np.linalg.norm(deepest - centre, axis=1).argmin()])
        clearance = float(room[row, column])
        point = np.array([left + column + 0.5, top + row + 0.5], np.float32)
        found.append(_measured(Contact(point, clearance), mask, depth, camera))
        room = np.where(np.hypot(rows - row, columns - column) < 2 * clearance, 0.0, room)
    return tuple(sorted(found, key=lambda contact: (contact.position_xyz is None, not contact.reachable)))


def _measured(contact: Contact, mask: np.ndarray, depth: np.ndarray | None, camera: Intrinsics | None) -> Contact:
    if depth is None or camera is None:
        return contact
    column, row = (int(x) for x in contact.point_xy)
    rows, columns = np.nonzero(mask & np.isfinite(depth))
    near = np.hypot(rows - row, columns - column) <= max(PATCH_PIXELS, 0.5 * contact.clearance)
    rows, columns = rows[near], columns[near]
    if not len(rows):
        return _without(contact, "no depth was measured there: a hole, a reflection, or out of range")
    if len(rows) < LEAST_PIXELS:
        return _without(contact, f"only {len(rows)} pixels near it have depth; a surface needs {LEAST_PIXELS}")
    z = depth[rows, columns]
    at = float(np.median(z[np.argsort(np.hypot(rows - row, columns - column))[:5]]))
    cloud = back_project(np.stack([columns, rows], axis=1) + 0.5, z, camera)
    position = back_project(contact.point_xy[None].astype(np.float64), np.array([at]), camera)[0]
    cloud = cloud[np.linalg.norm(cloud - position, axis=1) <= max(PATCH_METRES, 2 * at / camera.fx)]
    if len(cloud) < 3:
        return _without(contact, "depth jumps there: the pixels around it lie on another surface")
    spread, axes = np.linalg.eigh(np.cov(cloud.T))
    if spread[1] <= 1e-12:
        return _without(contact, "the measured pixels lie on one line, so no surface can be fitted")
    normal = axes[:, 0] if axes[:, 0] @ position < 0 else -axes[:, 0]
    facing = float(-normal @ position / np.linalg.norm(position))
    hidden = at - float(z.min()) > BEHIND
    reason = "seen through a gap" if hidden else "seen edge-on" if facing < FACING else ""
    return Contact(contact.point_xy, contact.clearance, position, normal, -normal, not reason, reason)


def _without(contact: Contact, reason: str) -> Contact:
    return Contact(contact.point_xy, contact.clearance, reachable=False, reason=reason)
