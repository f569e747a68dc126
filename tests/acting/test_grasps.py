"""Grasps on shapes whose truth is known, and the poses of others filtered."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from a4agent.acting.grasps import GripperSettings, filter_grasps, find_grasps, write_graspnet_input
from a4agent.acting.lifting import Intrinsics
from a4agent.errors import InputError
from a4agent.types import Affordance, Region

CAMERA = Intrinsics(500.0, 500.0, 159.5, 119.5)
SHAPE = (240, 320)


def bar(degrees: float, length: float = 160, width: float = 30) -> np.ndarray:
    rows, columns = np.indices(SHAPE)
    x, y = columns - CAMERA.cx, rows - CAMERA.cy
    angle = np.radians(degrees)
    along, across = x * np.cos(angle) + y * np.sin(angle), -x * np.sin(angle) + y * np.cos(angle)
    return (np.abs(along) < length / 2) & (np.abs(across) < width / 2)


def scene(mask: np.ndarray, height: float = 0.05) -> np.ndarray:
    """A part `height` metres above a table that is 0.55 m away."""
    return np.where(mask, 0.55 - height, 0.55)


@pytest.mark.parametrize("degrees", [0.0, 30.0, 90.0, 137.0])
def test_a_bar_is_grasped_across(degrees: float) -> None:
    mask = bar(degrees)
    grasps = find_grasps(mask, scene(mask), CAMERA)
    assert grasps
    best = grasps[0]
    across = np.array([-np.sin(np.radians(degrees)), np.cos(np.radians(degrees))])
    assert abs(float(best.pose[:2, 0] @ across)) > 0.95
    assert best.width == pytest.approx(30 * 0.5 / 500, rel=0.15)
    np.testing.assert_allclose(best.pose[:3, :3] @ best.pose[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(best.pose[:3, :3]) == pytest.approx(1.0)
    assert best.pose[2, 2] > 0.9
    assert list(grasps) == sorted(grasps, key=lambda grasp: -grasp.score)


def test_what_is_wider_than_the_gripper_is_not_grasped() -> None:
    mask = bar(0.0, length=200, width=120)
    assert not find_grasps(mask, scene(mask), CAMERA, GripperSettings(max_width=0.08))
    assert find_grasps(mask, scene(mask), CAMERA, GripperSettings(max_width=0.2))


def test_fingers_need_room_beside_the_part() -> None:
    mask = bar(0.0)
    assert not find_grasps(mask, scene(mask, height=0.002), CAMERA)
    walled = scene(mask)
    walled[: int(CAMERA.cy) - 14] = 0.5  # something as high stands against its upper side
    assert not find_grasps(mask, walled, CAMERA)


def test_a_ring_is_grasped_on_its_band() -> None:
    rows, columns = np.indices(SHAPE)
    radius = np.hypot(columns - CAMERA.cx, rows - CAMERA.cy)
    mask = (radius < 70) & (radius > 50)
    grasps = find_grasps(mask, scene(mask), CAMERA, GripperSettings(max_width=0.2))
    assert grasps
    for grasp in grasps:
        assert grasp.width < 0.04


def test_without_depth_there_is_nothing() -> None:
    mask = bar(0.0)
    assert find_grasps(mask, np.full(SHAPE, np.nan), CAMERA) == ()
    assert find_grasps(np.zeros(SHAPE, bool), np.full(SHAPE, 0.5), CAMERA) == ()


def test_external_poses_are_kept_where_they_close_on_the_part() -> None:
    mask = bar(0.0)
    region = Region(None, np.zeros((0, 2), np.float32), mask)
    affordance = Affordance("x", (SHAPE[1], SHAPE[0]), regions=(region,))
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 2, 3] = 0.5 - 0.1034
    poses[1, 0, 3] = 0.2  # beside the part
    poses[2, 2, 3] = 0.3 - 0.1034  # well before it
    poses[3, 2, 3] = -1.0  # behind the camera
    poses[4] = np.nan
    assert filter_grasps(affordance, scene(mask), CAMERA, poses) == [0]
    assert filter_grasps(affordance, scene(mask), CAMERA, []) == []
    with pytest.raises(InputError, match=r"\(n, 4, 4\), not \(4, 4\)"):
        filter_grasps(affordance, scene(mask), CAMERA, np.eye(4))


def test_the_input_of_contact_graspnet(tmp_path: Path) -> None:
    mask = bar(0.0)
    depth = scene(mask)
    depth[0, 0] = np.nan
    data = np.load(write_graspnet_input(tmp_path / "scene.npz", depth, CAMERA, mask))
    assert data["depth"].dtype == np.float32
    assert data["depth"][0, 0] == 0.0
    assert data["K"].tolist() == [[500.0, 0.0, 159.5], [0.0, 500.0, 119.5], [0.0, 0.0, 1.0]]
    assert data["segmap"].sum() == mask.sum()


@pytest.mark.parametrize("name", ["max_width", "depth", "finger", "friction"])
def test_a_gripper_without_size_is_refused(name: str) -> None:
    with pytest.raises(InputError, match=f"gripper's {name} must be above 0"):
        GripperSettings(**{name: 0.0})
