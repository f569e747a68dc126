"""Dicts in the shape of ROS 2 messages, to publish without this package depending on ROS.

    from rosidl_runtime_py import set_message_fields
    from vision_msgs.msg import Detection2DArray

    message = Detection2DArray()
    set_message_fields(message, detection_2d_array(affordance, frame_id="camera_color_optical_frame", stamp=stamp))

Fields follow vision_msgs 4 (Humble and later), geometry_msgs, sensor_msgs and std_msgs; a test compares every one
with the definitions. A stamp is seconds, or a pair (sec, nanosec) as in `node.get_clock().now().to_msg()`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from a4agent.acting.lifting import Frame, Lifted, LiftedRegion
from a4agent.types import Affordance

Message = dict[str, Any]
Stamp = float | tuple[int, int]


def header(frame_id: str, stamp: Stamp = 0.0) -> Message:
    """std_msgs/Header."""
    if isinstance(stamp, tuple):
        seconds, nanoseconds = stamp
    else:
        seconds, nanoseconds = divmod(round(stamp * 1_000_000_000), 1_000_000_000)
    return {"stamp": {"sec": int(seconds), "nanosec": int(nanoseconds)}, "frame_id": frame_id}


def detection_2d_array(affordance: Affordance, *, frame_id: str = "camera", stamp: Stamp = 0.0) -> Message:
    """vision_msgs/Detection2DArray: one detection for each region that has a box or a mask, in pixels, best first.

    The class is the part's name; a region without a score has the score 0.
    """
    detections: list[Message] = []
    at_origin = _pose(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    for number, region in enumerate(affordance.regions):
        if region.any_box_xyxy is None:
            continue
        x0, y0, x1, y1 = (float(edge) for edge in region.any_box_xyxy)
        detections.append(
            {
                "header": header(frame_id, stamp),
                "results": [_hypothesis(affordance.phrase, region.score, at_origin)],
                "bbox": {
                    "center": {"position": {"x": (x0 + x1) / 2, "y": (y0 + y1) / 2}, "theta": 0.0},
                    "size_x": x1 - x0,
                    "size_y": y1 - y0,
                },
                "id": str(number),
            }
        )
    return {"header": header(frame_id, stamp), "detections": detections}


def mask_image(affordance: Affordance, *, frame_id: str = "camera", stamp: Stamp = 0.0) -> Message:
    """sensor_msgs/Image, mono8: 255 on the part, 0 elsewhere. `data` is bytes."""
    width, height = affordance.size_wh
    return {
        "header": header(frame_id, stamp),
        "height": height,
        "width": width,
        "encoding": "mono8",
        "is_bigendian": 0,
        "step": width,
        "data": (affordance.mask.astype(np.uint8) * 255).tobytes(),
    }


def pose_array(lifted: Lifted, *, stamp: Stamp = 0.0) -> Message:
    """geometry_msgs/PoseArray: the contact frames that were measured, best first. A robot never sees NaN."""
    poses = [_pose(r.frame.origin, r.frame.quaternion_xyzw) for r in lifted.regions if r.frame.measured]
    return {"header": header(lifted.frame_id, stamp), "poses": poses}


def pose_stamped(pose: np.ndarray, *, frame_id: str = "camera", stamp: Stamp = 0.0) -> Message:
    """geometry_msgs/PoseStamped of a (4, 4) pose, such as `acting.grasps.Grasp.pose`."""
    frame = Frame(pose[:3, 3], pose[:3, :3])
    return {"header": header(frame_id, stamp), "pose": _pose(frame.origin, frame.quaternion_xyzw)}


def points_stamped(lifted: Lifted, *, stamp: Stamp = 0.0) -> list[Message]:
    """geometry_msgs/PointStamped, one for each key point that was measured."""
    return [
        {"header": header(lifted.frame_id, stamp), "point": _xyz(point)}
        for region in lifted.regions
        for point in region.points_xyz
        if np.isfinite(point).all()
    ]


def detection_3d_array(lifted: Lifted, *, stamp: Stamp = 0.0) -> Message:
    """vision_msgs/Detection3DArray: the box around each region's cloud, for the regions whose frame was measured.

    The pose of the hypothesis is the contact frame; the pose of the box is its centre.
    """
    detections: list[Message] = []
    for number, region in enumerate(lifted.regions):
        if not region.frame.measured:
            continue
        turned = region.frame.quaternion_xyzw
        detections.append(
            {
                "header": header(lifted.frame_id, stamp),
                "results": [_hypothesis(lifted.label, region.score, _pose(region.frame.origin, turned))],
                "bbox": {"center": _pose(region.centre_xyz, turned), "size": _xyz(region.size_xyz)},
                "id": str(number),
            }
        )
    return {"header": header(lifted.frame_id, stamp), "detections": detections}


def point_cloud(region: LiftedRegion, *, frame_id: str = "camera", stamp: Stamp = 0.0) -> Message:
    """sensor_msgs/PointCloud2 of one region: x, y, z as float32. `data` is bytes."""
    cloud = region.cloud_xyz.astype("<f4")
    fields = [{"name": name, "offset": 4 * i, "datatype": 7, "count": 1} for i, name in enumerate("xyz")]
    return {
        "header": header(frame_id, stamp),
        "height": 1,
        "width": len(cloud),
        "fields": fields,
        "is_bigendian": False,
        "point_step": 12,
        "row_step": 12 * len(cloud),
        "data": cloud.tobytes(),
        "is_dense": True,
    }


def _hypothesis(name: str, score: float | None, pose: Message) -> Message:
    return {
        "hypothesis": {"class_id": name, "score": 0.0 if score is None else float(score)},
        "pose": {"pose": pose, "covariance": [0.0] * 36},
    }


def _pose(origin: np.ndarray, quaternion_xyzw: np.ndarray) -> Message:
    x, y, z, w = (float(value) for value in quaternion_xyzw)
    return {"position": _xyz(origin), "orientation": {"x": x, "y": y, "z": z, "w": w}}


def _xyz(point: np.ndarray) -> Message:
    return dict(zip("xyz", (float(value) for value in point), strict=True))
