"""Every dict is compared, field by field and type by type, with the definition of its message."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

from a4agent.acting.lifting import Intrinsics, lift
from a4agent.interop import ros2
from a4agent.types import Affordance, Region, Target

DEFINITIONS: dict[str, dict[str, str]] = {
    "Time": {"sec": "int", "nanosec": "int"},
    "Header": {"stamp": "Time", "frame_id": "str"},
    "Point": {"x": "float", "y": "float", "z": "float"},
    "Vector3": {"x": "float", "y": "float", "z": "float"},
    "Quaternion": {"x": "float", "y": "float", "z": "float", "w": "float"},
    "Pose": {"position": "Point", "orientation": "Quaternion"},
    "PoseWithCovariance": {"pose": "Pose", "covariance": "float[36]"},
    "PoseArray": {"header": "Header", "poses": "Pose[]"},
    "PointStamped": {"header": "Header", "point": "Point"},
    "Point2D": {"x": "float", "y": "float"},
    "Pose2D": {"position": "Point2D", "theta": "float"},
    "BoundingBox2D": {"center": "Pose2D", "size_x": "float", "size_y": "float"},
    "BoundingBox3D": {"center": "Pose", "size": "Vector3"},
    "ObjectHypothesis": {"class_id": "str", "score": "float"},
    "ObjectHypothesisWithPose": {"hypothesis": "ObjectHypothesis", "pose": "PoseWithCovariance"},
    "Detection2D": {"header": "Header", "results": "ObjectHypothesisWithPose[]", "bbox": "BoundingBox2D", "id": "str"},
    "Detection2DArray": {"header": "Header", "detections": "Detection2D[]"},
    "Detection3D": {"header": "Header", "results": "ObjectHypothesisWithPose[]", "bbox": "BoundingBox3D", "id": "str"},
    "Detection3DArray": {"header": "Header", "detections": "Detection3D[]"},
    "Image": {
        "header": "Header",
        "height": "int",
        "width": "int",
        "encoding": "str",
        "is_bigendian": "int",
        "step": "int",
        "data": "bytes",
    },
    "PointField": {"name": "str", "offset": "int", "datatype": "int", "count": "int"},
    "PointCloud2": {
        "header": "Header",
        "height": "int",
        "width": "int",
        "fields": "PointField[]",
        "is_bigendian": "bool",
        "point_step": "int",
        "row_step": "int",
        "data": "bytes",
        "is_dense": "bool",
    },
}
PLAIN = {"int": int, "float": float, "str": str, "bytes": bytes, "bool": bool}


def check(value: Any, kind: str, place: str = "message") -> None:
    if kind.endswith("]"):
        of, _, count = kind[:-1].partition("[")
        assert isinstance(value, list), place
        assert not count or len(value) == int(count), place
        for i, item in enumerate(value):
            check(item, of, f"{place}[{i}]")
    elif kind in PLAIN:
        assert type(value) is PLAIN[kind], f"{place} is {value!r}, not {kind}"
    else:
        assert list(value) == list(DEFINITIONS[kind]), place
        for name, of in DEFINITIONS[kind].items():
            check(value[name], of, f"{place}.{name}")


@pytest.fixture
def affordance() -> Affordance:
    handle, far = np.zeros((40, 60), bool), np.zeros((40, 60), bool)
    handle[10:14, 20:40] = True
    far[30:34, 2:12] = True
    regions = (
        Region(np.array([20, 10, 40, 14], np.float32), np.array([[30, 12]], np.float32), handle, 0.9),
        Region(None, np.array([[7, 32]], np.float32), far, None),
        Region(None, np.zeros((0, 2), np.float32), np.zeros((40, 60), bool)),
    )
    return Affordance("open", (60, 40), target=Target("open", "drawer", "the handle of the drawer"), regions=regions)


@pytest.fixture
def depth() -> np.ndarray:
    depth = np.full((40, 60), 0.5)
    depth[25:] = np.nan  # nothing was measured below the handle
    return depth


CAMERA = Intrinsics(50, 50, 29.5, 19.5)


def test_detections_in_pixels(affordance: Affordance) -> None:
    message = ros2.detection_2d_array(affordance, frame_id="head", stamp=12.25)
    check(message, "Detection2DArray")
    first, second = message["detections"]  # the blank region has no box to send
    assert first["bbox"] == {
        "center": {"position": {"x": 30.0, "y": 12.0}, "theta": 0.0},
        "size_x": 20.0,
        "size_y": 4.0,
    }
    assert first["results"][0]["hypothesis"] == {"class_id": "the handle of the drawer", "score": pytest.approx(0.9)}
    assert second["bbox"]["size_x"] == 10.0
    assert message["header"] == {"stamp": {"sec": 12, "nanosec": 250_000_000}, "frame_id": "head"}


def test_mask_as_an_image(affordance: Affordance) -> None:
    message = ros2.mask_image(affordance)
    check(message, "Image")
    pixels = np.frombuffer(message["data"], np.uint8).reshape(message["height"], message["step"])
    assert ((pixels == 255) == affordance.mask).all()


def test_only_what_was_measured_reaches_a_robot(affordance: Affordance, depth: np.ndarray) -> None:
    lifted = lift(affordance, depth, CAMERA, frame_id="head")
    poses, points = ros2.pose_array(lifted, stamp=(3, 4)), ros2.points_stamped(lifted)
    boxes = ros2.detection_3d_array(lifted)
    check(poses, "PoseArray")
    check(points, "PointStamped[]")
    check(boxes, "Detection3DArray")
    assert len(poses["poses"]) == len(points) == len(boxes["detections"]) == 1
    assert poses["header"]["stamp"] == {"sec": 3, "nanosec": 4}
    assert points[0]["header"]["frame_id"] == "head"
    assert poses["poses"][0]["position"]["z"] == pytest.approx(0.5)
    assert ": nan" not in f"{poses} {points} {boxes}"


def test_point_cloud_can_be_read_back(affordance: Affordance, depth: np.ndarray) -> None:
    region = lift(affordance, depth, CAMERA).regions[0]
    message = ros2.point_cloud(region)
    check(message, "PointCloud2")
    cloud = np.frombuffer(message["data"], "<f4").reshape(message["width"], 3)
    assert cloud == pytest.approx(region.cloud_xyz, abs=1e-6)
    assert message["row_step"] == len(message["data"])


@pytest.mark.parametrize(
    ("stamp", "expected"),
    [(1.999999999999, (2, 0)), (0.1, (0, 100_000_000)), (1_700_000_000.5, (1_700_000_000, 500_000_000))],
)
def test_a_stamp_never_has_a_whole_second_of_nanoseconds(stamp: float, expected: tuple[int, int]) -> None:
    message = ros2.header("camera", stamp)
    assert (message["stamp"]["sec"], message["stamp"]["nanosec"]) == expected


def test_no_ros_is_needed() -> None:
    assert not {"rclpy", "vision_msgs", "geometry_msgs"} & set(sys.modules)


def test_a_grasp_is_a_stamped_pose() -> None:
    pose = np.array([[0.0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]])
    message = ros2.pose_stamped(pose, frame_id="camera", stamp=(1, 2))
    assert message["header"] == {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "camera"}
    assert message["pose"]["position"] == {"x": 0.1, "y": 0.2, "z": 0.3}
    turned = message["pose"]["orientation"]
    assert (turned["z"], turned["w"]) == pytest.approx((np.sqrt(0.5), np.sqrt(0.5)))
