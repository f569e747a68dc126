"""Where a parallel gripper can close on a part, from its mask and one depth image.

    grasps = find_grasps(affordance.mask, depth, camera, GripperSettings(max_width=0.085))
    grasps[0].pose            (4, 4) gripper in the camera's optical frame: x closes, y along the fingers, z approaches
    grasps[0].width           metres between the contacts
    kept = filter_grasps(affordance, depth, camera, poses)      # of GraspGen, AnyGrasp, contact_graspnet, ...

Candidates are antipodal pairs on the part's outline: places whose outward normals oppose each other within the
friction cone, closer than the gripper opens, with free space beside them for the fingers. Source of the method:
Mahler et al., Dex-Net 2.0 (RSS 2017), section IV: antipodal pairs sampled from depth edges.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from a4agent.acting.lifting import Intrinsics, back_project, median_depth, project
from a4agent.errors import InputError
from a4agent.types import Affordance


@dataclass(frozen=True)
class GripperSettings:
    """A parallel gripper: `max_width` between its fingers, `depth` they reach over the part, in metres.

    `finger` is a finger's thickness: so much beside the part has to be free. `friction` is the coefficient between
    finger and part.
    """

    max_width: float = 0.085
    depth: float = 0.02
    finger: float = 0.01
    friction: float = 0.5

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 < value < 10:
                raise InputError(
                    f"a gripper's {name} must be above 0 (metres; friction is a coefficient), not {value!r}"
                )


@dataclass(frozen=True, eq=False)
class Grasp:
    """One way to close on the part. `contacts_xy` (2, 2) are pixels, `score` is from 0 to 1."""

    pose: np.ndarray
    width: float
    score: float
    contacts_xy: np.ndarray


SAMPLES = 240
"""Places on the outline that are paired."""
STEP = 3.0
"""Pixels inside the outline at which the part's depth is read, and outside at which the space beside it is."""


def find_grasps(
    mask: np.ndarray,
    depth: np.ndarray,
    camera: Intrinsics,
    gripper: GripperSettings | None = None,
    *,
    count: int = 10,
) -> tuple[Grasp, ...]:
    """Up to `count` grasps, best first; none where depth is missing or nothing fits between the fingers.

    Args:
        mask: (H, W) bool.
        depth: (H, W) metres along the camera's axis, NaN where not measured (`lifting.metres_of`).
    """
    gripper = gripper or GripperSettings()
    points, normals = _outline(mask)
    if len(points) < 8:
        return ()
    own = np.where(mask, depth, np.nan)
    inside = np.array([median_depth(own, xy, 2) for xy in points - STEP * normals])
    usable = np.isfinite(inside)
    points, normals, inside = points[usable], normals[usable], inside[usable]
    if len(points) < 2:
        return ()
    xyz = back_project(points, inside, camera)
    first, second = np.triu_indices(len(points), 1)
    across = points[second] - points[first]
    gap = np.linalg.norm(across, axis=1)
    direction = across / np.maximum(gap, 1e-9)[:, None]
    opposed = np.minimum(-(normals[first] * direction).sum(1), (normals[second] * direction).sum(1))
    width = np.linalg.norm(xyz[second] - xyz[first], axis=1)
    cone = 1.0 / np.hypot(1.0, gripper.friction)
    fits = (gap > 1) & (opposed >= cone) & (width <= gripper.max_width)
    order = np.flatnonzero(fits)
    order = order[np.argsort(-opposed[order] * (1.0 - 0.5 * width[order] / gripper.max_width), kind="stable")]
    grasps: list[Grasp] = []
    taken: list[np.ndarray] = []
    middle = np.argwhere(mask).mean(0)[::-1] + 0.5
    extent = max(float(np.sqrt(mask.sum())), 1.0)
    for pair in order:
        centre_xy = (points[first[pair]] + points[second[pair]]) / 2
        if any(np.linalg.norm(centre_xy - other) < 0.15 * extent for other in taken):
            continue
        clear = min(
            _free_beside(depth, points[k], normals[k], float(inside[k]), camera, gripper)
            for k in (first[pair], second[pair])
        )
        if clear <= 0 or not _on_part(mask, points[first[pair]], points[second[pair]]):
            continue
        central = float(np.exp(-np.linalg.norm(centre_xy - middle) / (2 * extent)))
        score = float(opposed[pair]) * (1.0 - 0.5 * float(width[pair]) / gripper.max_width) * clear * central
        contacts = np.stack([points[first[pair]], points[second[pair]]])
        pose = _pose(xyz[first[pair]], xyz[second[pair]], gripper)
        grasps.append(Grasp(pose, float(width[pair]), float(np.clip(score, 0.0, 1.0)), contacts))
        taken.append(centre_xy)
        if len(grasps) >= 3 * count:
            break
    return tuple(sorted(grasps, key=lambda grasp: -grasp.score)[:count])


def filter_grasps(
    affordance: Affordance,
    depth: np.ndarray,
    camera: Intrinsics,
    poses: np.ndarray | Sequence[np.ndarray],
    *,
    reach: float = 0.1034,
    tolerance: float = 0.03,
) -> list[int]:
    """The indices of the poses that close on the part, in their order.

    Args:
        poses: (n, 4, 4) gripper frames in the camera's optical frame, z approaching, as contact_graspnet, GraspGen and
            AnyGrasp give them.
        reach: metres along z from the frame's origin to between the finger tips (0.1034 for the Panda hand).
        tolerance: metres that this point may lie before or behind the part's surface.

    Raises:
        InputError: the poses are not (n, 4, 4).
    """
    frames = np.asarray(poses, np.float64)
    if frames.size == 0:
        return []
    if frames.ndim != 3 or frames.shape[1:] != (4, 4):
        raise InputError(f"poses must have the shape (n, 4, 4), not {frames.shape}")
    tips = frames[:, :3, 3] + reach * frames[:, :3, 2]
    mask, (height, width) = affordance.mask, affordance.mask.shape
    own = np.where(mask, depth, np.nan)
    kept: list[int] = []
    for index in np.flatnonzero(np.isfinite(tips).all(1) & (tips[:, 2] > 0)):
        xy = project(tips[index : index + 1], camera)[0]
        column, row = np.floor(xy)
        if not (0 <= column < width and 0 <= row < height and mask[int(row), int(column)]):
            continue
        surface = median_depth(own, xy, 2)
        if np.isfinite(surface) and abs(tips[index, 2] - surface) <= tolerance:
            kept.append(int(index))
    return kept


def write_graspnet_input(path: Path, depth: np.ndarray, camera: Intrinsics, mask: np.ndarray) -> Path:
    """Write the npz that contact_graspnet reads: `depth` in metres, `K`, and `segmap` with 1 on the part."""
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    metres = np.nan_to_num(depth, nan=0.0).astype(np.float32)
    np.savez_compressed(path, depth=metres, K=matrix, segmap=mask.astype(np.uint8))
    return path


def _outline(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 2) evenly on the outline and their outward unit normals (n, 2), in pixels."""
    from scipy.ndimage import binary_erosion, gaussian_filter

    inner = mask & np.logical_not(binary_erosion(mask))
    rows, columns = np.nonzero(inner)
    if not len(rows):
        return np.zeros((0, 2)), np.zeros((0, 2))
    soft = np.asarray(gaussian_filter(np.pad(mask.astype(np.float64), 4), 2.0))
    down, right = (cast(Any, g)[4:-4, 4:-4] for g in np.gradient(soft))
    normals = -np.stack([right[rows, columns], down[rows, columns]], axis=1)
    length = np.linalg.norm(normals, axis=1)
    good = length > 1e-6
    points = np.stack([columns, rows], axis=1)[good] + 0.5
    normals = normals[good] / length[good, None]
    if len(points) > SAMPLES:
        chosen = np.linspace(0, len(points) - 1, SAMPLES).round().astype(int)
        points, normals = points[chosen], normals[chosen]
    return points, normals


def _free_beside(
    depth: np.ndarray, xy: np.ndarray, normal: np.ndarray, surface: float, camera: Intrinsics, gripper: GripperSettings
) -> float:
    """How free the space for a finger is, 0..1: what lies beside the part must be `gripper.depth` farther away.

    Unmeasured pixels beside an edge are usual (the sensor's shadow) and count half.
    """
    height, width = depth.shape
    reach = max(gripper.finger * camera.fx / surface, 2 * STEP)
    steps = xy + np.linspace(STEP, reach, 5)[:, None] * normal
    free = 0.0
    for x, y in np.floor(steps).astype(int):
        if not (0 <= x < width and 0 <= y < height):
            free += 0.5
            continue
        beside = depth[y, x]
        if not np.isfinite(beside):
            free += 0.5
        elif beside - surface >= gripper.depth:
            free += 1.0
        elif beside - surface < 0.5 * gripper.depth:
            return 0.0
        else:
            free += 0.5
    return free / len(steps)


def _on_part(mask: np.ndarray, a: np.ndarray, b: np.ndarray) -> bool:
    """Whether most of the way between two contacts lies on the part: not across the hole of a ring."""
    along = a + np.linspace(0.1, 0.9, 17)[:, None] * (b - a)
    columns, rows = np.floor(along).astype(int).T
    return bool(mask[rows, columns].mean() > 0.8)


def _pose(a: np.ndarray, b: np.ndarray, gripper: GripperSettings) -> np.ndarray:
    """x from contact to contact, z along the view ray made square to it, the origin `depth` behind the surface."""
    middle = (a + b) / 2
    x = (b - a) / np.linalg.norm(b - a)
    z = middle / np.linalg.norm(middle)
    z = z - (z @ x) * x
    z = z / np.linalg.norm(z)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = x, np.cross(z, x), z
    pose[:3, 3] = middle + 0.5 * gripper.depth * z
    return pose
