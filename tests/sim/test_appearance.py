"""The camera that is written down is the one that took the picture."""

from __future__ import annotations

import numpy as np
import pytest

from a4agent.sim.appearance import SIZES_WH, draw_size, draw_yaw
from a4agent.sim.catalogue import Catalogue
from a4agent.sim.draw import Drawn
from a4agent.sim.placing import bounds

NAMES = ["drawer", "sink cabinet", "dial"]


@pytest.mark.parametrize("name", NAMES)
def test_depth_and_camera_lift_the_mask_onto_the_part(drawn: dict[str, Drawn], name: str) -> None:
    sample = drawn[name]
    for number, geoms in enumerate(sample.scene.part_geoms.values(), start=1):
        rows, columns = np.nonzero(sample.regions == number)
        points = _lift(sample, rows, columns)
        low, high = bounds(sample.scene.model, sample.scene.data, geoms)
        assert (points > low - 0.004).all()
        assert (points < high + 0.004).all()


def test_the_camera_matrix_projects_a_known_point(drawn: dict[str, Drawn]) -> None:
    sample = drawn["drawer"]
    low, high = bounds(sample.scene.model, sample.scene.data, sample.scene.part_geoms["handle"])
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    turn, eye = sample.camera.pose[:3, :3], sample.camera.pose[:3, 3]
    seen = (corners - eye) @ turn @ sample.camera.matrix.T
    pixels = seen[:, :2] / seen[:, 2:]
    rows, columns = np.nonzero(sample.regions == 1)
    assert pixels[:, 0].min() - 1 <= columns.min()
    assert columns.max() <= pixels[:, 0].max() + 1
    assert pixels[:, 1].min() - 1 <= rows.min()
    assert rows.max() <= pixels[:, 1].max() + 1


def test_sizes_and_directions_stay_in_their_range(catalogue: Catalogue) -> None:
    rng = np.random.default_rng(0)
    assert {draw_size(rng) for _ in range(100)} == set(SIZES_WH)
    thing = catalogue.thing("drawer")
    yaws = np.degrees([draw_yaw(thing, rng) for _ in range(100)])
    assert np.abs(yaws - thing.front).max() <= thing.spread
    assert np.ptp(yaws) > thing.spread


def _lift(sample: Drawn, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    depth = sample.depth[rows, columns]
    pixels = np.stack([columns, rows, np.ones(len(rows))])
    camera = np.linalg.inv(sample.camera.matrix) @ pixels * depth
    return (sample.camera.pose[:3, :3] @ camera).T + sample.camera.pose[:3, 3]
