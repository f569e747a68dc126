"""From pixels to metres: key points, point cloud and contact frame of each region, from a depth image.

    lifted = lift(affordance, depth, Intrinsics(fx=615.0, fy=615.0, cx=319.5, cy=239.5), frame_id="camera")
    lifted.regions[0].points_xyz       (k, 3)  the key points, NaN where no depth was measured
    lifted.regions[0].cloud_xyz        (n, 3)  the part's surface
    lifted.regions[0].frame            where to put the gripper: origin, rotation (3, 3), quaternion_xyzw

Everything is in metres in the camera's optical frame: x right, y down, z forward (ROS REP 103). Intrinsics follow
OpenCV and ROS, where (0, 0) is the centre of the first pixel; an affordance's points count from its corner, half a
pixel earlier. Depth is z, not the length of the ray.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from a4agent.errors import InputError
from a4agent.imaging.load import read_pixels
from a4agent.types import Affordance, Region

OUTLIER_MADS = 6.0
"""Pixels of the mask whose depth is further from its median than this many scaled MADs belong to something else."""
LEAST_BAND = 0.02
"""Metres around the median depth that are never outliers: a flat part has a MAD near zero."""
PATCH = 0.015
"""Metres around the contact within which the surface normal is fitted; at least the nearest LEAST_POINTS points."""
LEAST_POINTS = 12


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera: focal lengths and principal point in pixels of the depth image.

    Raises:
        InputError: a focal length is not positive, as those of a camera that was never calibrated.
    """

    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        if not (0 < self.fx < np.inf and 0 < self.fy < np.inf):
            raise InputError(f"focal lengths are positive, not {self.fx:g} and {self.fy:g}; calibrate the camera first")

    @classmethod
    def of(cls, matrix: np.ndarray) -> Intrinsics:
        """From a camera matrix K, (3, 3) or its nine numbers row by row (ROS `CameraInfo.k`)."""
        k = np.asarray(matrix, np.float64)
        if k.size != 9:
            raise InputError(f"a camera matrix has 3 x 3 numbers, not the shape {k.shape}")
        k = k.reshape(3, 3)
        return cls(float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]))

    @classmethod
    def read(cls, path: Path) -> Intrinsics:
        """From a JSON file: {"fx", "fy", "cx", "cy"}, or a matrix under "K", "k", "camera_matrix" or alone.

        Raises:
            InputError: it cannot be read, or holds no camera.
        """
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
            if isinstance(data, dict):
                table = cast("dict[str, Any]", data)
                if {"fx", "fy", "cx", "cy"} <= set(table):
                    return cls(*(float(table[name]) for name in ("fx", "fy", "cx", "cy")))
                data = next(table[name] for name in ("K", "k", "camera_matrix") if name in table)
            return cls.of(np.asarray(data, np.float64))
        except StopIteration:
            raise InputError(f"{str(path)!r} holds neither fx, fy, cx, cy nor a matrix K") from None
        except (OSError, ValueError, TypeError, RecursionError) as error:
            raise InputError(f"cannot read the camera {str(path)!r}: {error}") from error


@dataclass(frozen=True, eq=False)
class Frame:
    """A pose at the contact. Columns of `rotation` (3, 3): x along the part's long side, y across it, z into the part.

    A parallel gripper approaches along z and closes along y. NaN throughout where it could not be measured.
    """

    origin: np.ndarray
    rotation: np.ndarray

    @property
    def measured(self) -> bool:
        return bool(np.isfinite(self.rotation).all() and np.isfinite(self.origin).all())

    @property
    def quaternion_xyzw(self) -> np.ndarray:
        """The rotation as a unit quaternion (4,), w not negative."""
        from scipy.spatial.transform import Rotation

        if not self.measured:
            return np.full(4, np.nan)
        quaternion = cast(np.ndarray, Rotation.from_matrix(self.rotation).as_quat())
        return quaternion if quaternion[3] >= 0 else -quaternion


@dataclass(frozen=True, eq=False)
class LiftedRegion:
    """One region in 3D. `pixels_xy` (n, 2) int are the columns and rows that `cloud_xyz` (n, 3) was measured at.

    `centre_xyz` (3,) and `size_xyz` (3,) are the box around the cloud along the frame's axes; NaN without a frame.
    """

    points_xyz: np.ndarray
    cloud_xyz: np.ndarray
    pixels_xy: np.ndarray
    frame: Frame
    centre_xyz: np.ndarray
    size_xyz: np.ndarray
    score: float | None = None


@dataclass(frozen=True, eq=False)
class Lifted:
    """An affordance in 3D: its regions in their order, in the frame `frame_id`, in metres."""

    frame_id: str
    regions: tuple[LiftedRegion, ...]
    label: str = ""


def lift(
    affordance: Affordance,
    depth: np.ndarray,
    intrinsics: Intrinsics | np.ndarray,
    *,
    depth_scale: float | None = None,
    frame_id: str = "camera",
    radius: int = 4,
) -> Lifted:
    """Lift every region with a depth image (H, W) registered to the picture.

    Args:
        depth: z; float in metres, or integers with `depth_scale`. 0, negative, NaN and infinite mean "not measured".
        intrinsics: of the picture's camera, or its matrix K (3, 3).
        depth_scale: metres per unit (0.001 for millimetres). Required for integers, 1 for floats.
        frame_id: the name of the camera's optical frame, kept with the result.
        radius: a key point's depth is the median over the region's pixels at most this far from it, in x and y.

    Raises:
        InputError: the depth image has another size than the picture, or integers without `depth_scale`; or an answer
            of `a4agent.client`.
    """
    if not isinstance(cast(Any, affordance), Affordance):
        raise InputError(
            f"lift takes an a4agent.Affordance, not {type(affordance).__module__}.{type(affordance).__name__}; an"
            " answer of a4agent.client becomes one by Affordance.from_dict(answer.to_dict())"
        )
    camera = intrinsics if isinstance(intrinsics, Intrinsics) else Intrinsics.of(intrinsics)
    metres = metres_of(depth, affordance.size_wh, depth_scale)
    label = affordance.phrase
    regions = tuple(_lift_region(region, metres, camera, radius) for region in affordance.regions)
    return Lifted(frame_id, regions, label)


def back_project(points_xy: np.ndarray, z: np.ndarray, camera: Intrinsics) -> np.ndarray:
    """Points (n, 2) in an affordance's pixels at depths (n,) -> (n, 3) metres; NaN depth gives NaN."""
    x = (points_xy[:, 0] - 0.5 - camera.cx) * z / camera.fx
    y = (points_xy[:, 1] - 0.5 - camera.cy) * z / camera.fy
    return np.stack([x, y, z], axis=1)


def project(points_xyz: np.ndarray, camera: Intrinsics) -> np.ndarray:
    """Points (n, 3) as an affordance's pixels (n, 2), the inverse of `back_project`.

    A point behind the camera is projected from just in front of it.
    """
    z = np.maximum(points_xyz[:, 2], 1e-3)
    x = points_xyz[:, 0] * camera.fx / z + camera.cx + 0.5
    return np.stack([x, points_xyz[:, 1] * camera.fy / z + camera.cy + 0.5], axis=1)


def median_depth(depth: np.ndarray, xy: np.ndarray, radius: int) -> float:
    """The median of what was measured within `radius` pixels of a point (2,), in x and y; NaN if nothing was."""
    column, row = (int(v) for v in np.floor(xy))
    rows = slice(max(row - radius, 0), max(row + radius + 1, 0))
    window = depth[rows, max(column - radius, 0) : max(column + radius + 1, 0)]
    measured = window[np.isfinite(window)]
    return float(np.median(measured)) if measured.size else float("nan")


def metres_of(depth: np.ndarray, size_wh: tuple[int, int], depth_scale: float | None = None) -> np.ndarray:
    """A depth image (H, W) as float64 metres, NaN where nothing was measured.

    Raises:
        InputError: another size than the picture, or integers without `depth_scale` (metres per unit).
    """
    depth = np.asarray(depth)
    if depth.dtype.kind not in "fiu":
        raise InputError(f"a depth image is of numbers, not {depth.dtype}")
    width, height = size_wh
    if depth.shape != (height, width):
        raise InputError(
            f"the depth image has the shape {depth.shape}, the picture {(height, width)};"
            " register the depth to the colour camera first"
        )
    if depth_scale is None:
        if depth.dtype.kind != "f":
            raise InputError(
                f"depth of type {depth.dtype} has no unit; set depth_scale, metres per unit (0.001 for millimetres)"
            )
        depth_scale = 1.0
    metres = depth.astype(np.float64) * depth_scale
    return np.where(np.isfinite(metres) & (metres > 0), metres, np.nan)


def read_depth(path: Path, size_wh: tuple[int, int], depth_scale: float = 0.001) -> np.ndarray:
    """A depth picture (16-bit PNG or TIFF) or a .npy array, as (H, W) float64 metres, NaN where not measured.

    Args:
        depth_scale: metres per unit of integer files; floats are metres.

    Raises:
        InputError: it cannot be read, or is not of the picture's size.
    """
    try:
        # Mapped: no memory is taken for what a header claims and the file does not have.
        values = np.lib.format.open_memmap(path, mode="r") if path.suffix == ".npy" else read_pixels(path)
    except InputError as error:
        raise InputError(f"cannot read the depth {str(path)!r}: {error}") from error
    except Exception as error:  # numpy raises errors of many kinds for a forged header
        raise InputError(f"cannot read the depth {str(path)!r}: {error!r}") from error
    return metres_of(values, size_wh, None if values.dtype.kind == "f" else depth_scale)


def _lift_region(region: Region, metres: np.ndarray, camera: Intrinsics, radius: int) -> LiftedRegion:
    own = np.where(region.mask, metres, np.nan)
    own[~_inliers(own)] = np.nan
    rows, columns = np.nonzero(np.isfinite(own))
    pixels = np.stack([columns, rows], axis=1)
    cloud = back_project(pixels + 0.5, own[rows, columns], camera)
    points = region.points_xy.reshape(-1, 2).astype(np.float64)
    points_xyz = back_project(points, np.array([median_depth(own, xy, radius) for xy in points]), camera)
    frame = _frame(_contact(points_xyz, cloud), cloud)
    centre, size = _box_along(frame, cloud)
    return LiftedRegion(points_xyz, cloud, pixels, frame, centre, size, region.score)


def _inliers(depth: np.ndarray) -> np.ndarray:
    """Where the depth is measured and near the region's own: flying pixels and a mask that spills over are neither."""
    measured = depth[np.isfinite(depth)]
    if not measured.size:
        return np.zeros(depth.shape, bool)
    median = np.median(measured)
    spread = 1.4826 * np.median(np.abs(measured - median))
    return np.abs(depth - median) <= max(OUTLIER_MADS * spread, LEAST_BAND)


def _contact(points_xyz: np.ndarray, cloud: np.ndarray) -> np.ndarray:
    """The first key point that was measured, else the point of the cloud nearest to the cloud's median."""
    measured = points_xyz[np.isfinite(points_xyz).all(1)]
    if len(measured):
        return measured[0]
    if not len(cloud):
        return np.full(3, np.nan)
    return cloud[np.linalg.norm(cloud - np.median(cloud, axis=0), axis=1).argmin()]


def _frame(origin: np.ndarray, cloud: np.ndarray) -> Frame:
    if len(cloud) < 3 or not np.isfinite(origin).all():
        return Frame(origin, np.full((3, 3), np.nan))
    distance = np.linalg.norm(cloud - origin, axis=1)
    reach = max(PATCH, np.sort(distance)[min(LEAST_POINTS, len(cloud)) - 1])
    spread, axes = np.linalg.eigh(np.cov(cloud[distance <= reach].T))
    if spread[1] <= 1e-12:  # all on one line: no surface to stand on
        return Frame(origin, np.full((3, 3), np.nan))
    into = axes[:, 0] if axes[:, 0] @ origin > 0 else -axes[:, 0]
    long_side = np.linalg.eigh(np.cov(cloud.T))[1][:, 2]
    along = long_side - (long_side @ into) * into
    if np.linalg.norm(along) < 1e-3:  # the part points straight at the camera
        along = axes[:, 2]
    along = along / np.linalg.norm(along)
    along = along if along[np.abs(along).argmax()] > 0 else -along
    return Frame(origin, np.stack([along, np.cross(into, along), into], axis=1))


def _box_along(frame: Frame, cloud: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if not frame.measured:
        return np.full(3, np.nan), np.full(3, np.nan)
    within = (cloud - frame.origin) @ frame.rotation
    low, high = within.min(0), within.max(0)
    return frame.origin + frame.rotation @ ((low + high) / 2), high - low
