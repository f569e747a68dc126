"""The hand takes hold where it should, and the camera and the world agree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from a4agent.acting.contact import contact_points
from a4agent.errors import DataError
from a4agent.sim.act import BY_NAME
from a4agent.sim.act_trial import Trial


@pytest.mark.parametrize("name", ["hammer-lift", "handle-pull", "plug-pull"])
def test_open_fingers_take_hold_and_closed_ones_do_not(name: str, simulator: None) -> None:
    task = BY_NAME[name]
    with Trial(task, 0) as trial:
        view = trial.photograph()
        contact = contact_points(view.part, view.depth.astype(np.float64), view.camera)[0]
        assert contact.position_xyz is not None
        place = view.to_world(contact.position_xyz)
        assert trial.act(place).success
    with Trial(replace(task, grasp=None), 0) as trial:
        assert not trial.act(place).success


def test_the_microwave_of_another_package_opens(simulator: None) -> None:
    task = BY_NAME["microwave-open"]
    with Trial(task, 0) as trial:
        view = trial.photograph()
        contact = contact_points(view.part, view.depth.astype(np.float64), view.camera)[0]
        assert contact.position_xyz is not None
        assert trial.act(view.to_world(contact.position_xyz)).success
        assert view.image[:40].mean() > 60, "the sky of the scene is still there"
        assert float(trial.data.qpos[9]) < -0.45


def test_the_hand_does_not_move_for_a_point_out_of_reach(simulator: None) -> None:
    with Trial(BY_NAME["button-press"], 0) as trial:
        before = trial.data.qpos.copy()
        filmed: list[int] = []
        outcome = trial.act(np.array([-30.0, 50.0, -10.0]), lambda: filmed.append(1))
        assert (outcome.success, outcome.steps, len(filmed)) == (False, 0, 1)
        assert (trial.data.qpos == before).all()


def test_a_guest_that_is_not_in_its_file_is_named(simulator: None) -> None:
    task = BY_NAME["microwave-open"]
    assert task.guest is not None
    with pytest.raises(DataError, match=r"microwave-open.* needs a body .* and 'no-oven'"):
        Trial(replace(task, guest=replace(task.guest, root="no-oven")), 0)


def test_the_picture_and_the_world_agree(simulator: None) -> None:
    with Trial(BY_NAME["button-press"], 1) as trial:
        view = trial.photograph()
        contact = contact_points(view.part, view.depth.astype(np.float64), view.camera)[0]
        assert contact.position_xyz is not None
        centre = np.asarray(trial.data.geom("btnGeom").xpos)
        assert np.linalg.norm(view.to_world(contact.position_xyz) - centre) < 0.04
    assert view.part[~view.thing].sum() == 0
    assert view.image.shape == (480, 640, 3)
