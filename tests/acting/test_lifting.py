"""Lifting is checked against scenes whose geometry is known: planes and boards seen by a pinhole camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from a4agent import client
from a4agent.acting.lifting import Intrinsics, Lifted, LiftedRegion, back_project, lift, read_depth
from a4agent.errors import InputError
from a4agent.types import Affordance, Region

CAMERA = Intrinsics(fx=300.0, fy=310.0, cx=79.5, cy=59.5)
WIDTH, HEIGHT = 160, 120


def plane_depth(normal: np.ndarray, distance: float) -> np.ndarray:
    """The z at which each pixel's ray meets the plane normal . p = distance."""
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy, np.ones((HEIGHT, WIDTH))], -1)
    return distance / (rays @ normal)


def affordance(mask: np.ndarray, points: list[list[float]] | None = None) -> Affordance:
    region = Region(None, np.array(points or [], np.float32).reshape(-1, 2), mask, 0.8)
    return Affordance("open the drawer", (mask.shape[1], mask.shape[0]), regions=(region,))


def bar(rows: slice = slice(55, 65), columns: slice = slice(30, 130)) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[rows, columns] = True
    return mask


def only(lifted: Lifted) -> LiftedRegion:
    (region,) = lifted.regions
    return region


def test_a_wall_straight_ahead() -> None:
    depth = np.full((HEIGHT, WIDTH), 0.75)
    region = only(lift(affordance(bar(), [[80.0, 60.0]]), depth, CAMERA, frame_id="head"))
    assert region.points_xyz == pytest.approx(
        np.array([[0.0, 0.0, 0.75]]), abs=1e-9
    )  # the principal point's pixel edge
    assert region.frame.rotation == pytest.approx(np.eye(3), abs=1e-6)
    assert region.frame.quaternion_xyzw == pytest.approx([0, 0, 0, 1], abs=1e-6)
    assert region.size_xyz == pytest.approx([99 * 0.75 / 300, 9 * 0.75 / 310, 0.0], abs=1e-6)
    assert len(region.cloud_xyz) == bar().sum()


@given(tilt=st.floats(-0.9, 0.9), turn=st.floats(-0.9, 0.9), distance=st.floats(0.3, 3.0), upright=st.booleans())
def test_the_frame_stands_on_any_plane(tilt: float, turn: float, distance: float, upright: bool) -> None:
    normal = np.array([np.sin(turn) * np.cos(tilt), np.sin(tilt), np.cos(turn) * np.cos(tilt)])
    mask = bar(slice(20, 100), slice(76, 84)) if upright else bar()
    depth = plane_depth(normal, distance)
    frame = only(lift(affordance(mask, [[80.0, 60.0]]), depth, CAMERA)).frame
    assert frame.rotation.T @ frame.rotation == pytest.approx(np.eye(3), abs=1e-6)
    assert np.linalg.det(frame.rotation) == pytest.approx(1.0)
    assert frame.rotation[:, 2] == pytest.approx(normal, abs=1e-4)  # z goes into the surface, away from the camera
    assert np.argmax(np.abs(frame.rotation[:, 0])) == (1 if upright else 0) or abs(tilt) + abs(turn) > 0.7
    assert frame.origin @ normal == pytest.approx(distance, rel=0.02)


@given(
    points=st.lists(st.tuples(st.floats(0, WIDTH), st.floats(0, HEIGHT)), min_size=1, max_size=5),
    z=st.floats(0.1, 10.0),
)
def test_projecting_back_is_the_inverse_of_the_camera(points: list[tuple[float, float]], z: float) -> None:
    xyz = back_project(np.array(points), np.full(len(points), z), CAMERA)
    u = CAMERA.fx * xyz[:, 0] / xyz[:, 2] + CAMERA.cx
    v = CAMERA.fy * xyz[:, 1] / xyz[:, 2] + CAMERA.cy
    assert np.stack([u, v], 1) + 0.5 == pytest.approx(np.array(points), abs=1e-6)


def test_missing_depth_is_nan_and_is_not_guessed_from_outside_the_part() -> None:
    depth = np.full((HEIGHT, WIDTH), 0.6)
    depth[bar()] = 0.0
    depth[60, 120:125] = np.nan
    region = only(lift(affordance(bar(), [[80.0, 60.0], [122.0, 60.0]]), depth, CAMERA))
    assert np.isnan(region.points_xyz).all()
    assert region.cloud_xyz.shape == (0, 3)
    assert not region.frame.measured
    assert np.isnan(region.frame.quaternion_xyzw).all()
    assert np.isnan(region.size_xyz).all()


def test_a_hole_under_the_key_point_is_bridged_by_its_neighbours_in_the_mask() -> None:
    depth = np.full((HEIGHT, WIDTH), 2.0)
    depth[bar()] = 0.5
    depth[58:63, 78:83] = 0.0
    region = only(lift(affordance(bar(), [[80.5, 60.5]]), depth, CAMERA))
    assert region.points_xyz[0, 2] == pytest.approx(0.5)


def test_a_mask_that_spills_onto_the_background_does_not_pull_the_part_back() -> None:
    depth = np.full((HEIGHT, WIDTH), 3.0)
    depth[57:65, 30:130] = 0.5
    noise = np.random.default_rng(0).normal(0, 0.001, depth.shape)
    region = only(lift(affordance(bar(), [[80.0, 57.0]]), depth + noise, CAMERA))  # two of ten rows are background
    assert region.cloud_xyz[:, 2].max() < 0.6
    assert region.points_xyz[0, 2] == pytest.approx(0.5, abs=0.003)
    assert region.size_xyz[2] < 0.02


@pytest.mark.parametrize("point", [[-30.0, 60.0], [80.0, -30.0], [400.0, 60.0], [80.0, 400.0]])
def test_a_key_point_outside_the_picture_is_not_measured(point: list[float]) -> None:
    region = only(lift(affordance(bar(), [point]), np.full((HEIGHT, WIDTH), 0.75), CAMERA))
    assert np.isnan(region.points_xyz).all()


def test_a_camera_that_was_never_calibrated_is_refused() -> None:
    with pytest.raises(InputError, match="calibrate"):
        lift(affordance(bar()), np.ones((HEIGHT, WIDTH)), np.zeros((3, 3)))
    with pytest.raises(InputError, match="calibrate"):
        Intrinsics(500.0, float("nan"), 80.0, 60.0)


def test_millimetres_need_their_scale() -> None:
    millimetres = np.full((HEIGHT, WIDTH), 750, np.uint16)
    with pytest.raises(InputError, match="depth_scale"):
        lift(affordance(bar()), millimetres, CAMERA)
    region = only(lift(affordance(bar()), millimetres, CAMERA, depth_scale=0.001))
    assert region.frame.origin[2] == pytest.approx(0.75)


def test_a_damaged_depth_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "depth.npy"
    np.save(path, np.full((HEIGHT, WIDTH), 0.75, np.float32))
    good = path.read_bytes()
    assert np.nanmax(read_depth(path, (WIDTH, HEIGHT))) == pytest.approx(0.75)
    forged = good.replace(b"(120, 160)", b"(9999999999999,)")
    for damaged in (b"", b"PK\3\4 an archive", good[:-1], forged, good.replace(b"'<f4'", b"(((((")):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match="cannot read the depth"):
            read_depth(path, (WIDTH, HEIGHT))
    np.save(path, np.full((HEIGHT, WIDTH), "deep"))
    with pytest.raises(InputError, match="of numbers"):
        read_depth(path, (WIDTH, HEIGHT))


def test_depth_of_another_size_is_refused() -> None:
    with pytest.raises(InputError, match="register"):
        lift(affordance(bar()), np.ones((60, 80)), CAMERA)


def test_a_camera_matrix_is_accepted_and_checked() -> None:
    matrix = np.array([[300.0, 0, 79.5], [0, 310.0, 59.5], [0, 0, 1]])
    assert Intrinsics.of(matrix) == CAMERA == Intrinsics.of(matrix.ravel())
    with pytest.raises(InputError, match="3 x 3"):
        Intrinsics.of(np.eye(4))


@pytest.mark.parametrize("pixels", [[(60, 80)], [(60, 80), (60, 81)], [(60, column) for column in range(40, 90)]])
def test_too_little_surface_has_no_frame_but_keeps_its_points(pixels: list[tuple[int, int]]) -> None:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    for row, column in pixels:
        mask[row, column] = True
    region = only(lift(affordance(mask, [[80.5, 60.5]]), np.full((HEIGHT, WIDTH), 1.0), CAMERA))
    assert region.points_xyz[0, 2] == 1.0
    assert not region.frame.measured
    assert len(region.cloud_xyz) == len(pixels)


def test_an_answer_of_the_client_is_told_how_to_become_an_affordance() -> None:
    answer = Affordance("pull", (4, 3), status="empty").to_dict()
    answer["action"] = {"contacts": [], "grasps": [], "reason": ""}
    with pytest.raises(InputError, match=r"Affordance\.from_dict\(answer\.to_dict\(\)\)"):
        lift(client.Affordance.from_dict(answer), np.ones((3, 4)), np.eye(3))  # type: ignore[arg-type]


def test_nothing_found_lifts_to_nothing() -> None:
    assert lift(Affordance("x", (WIDTH, HEIGHT)), np.ones((HEIGHT, WIDTH)), CAMERA).regions == ()
