from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from a4agent.acting.contact import Contact
from a4agent.acting.grasps import Grasp
from a4agent.acting.lifting import Intrinsics, lift
from a4agent.acting.plan import ActionPlan
from a4agent.interop import rerun as adapter
from a4agent.types import Affordance, Imagination, Region, Target

rr = pytest.importorskip("rerun", reason="needs the extra interop")


def affordance() -> Affordance:
    mask = np.zeros((20, 30), bool)
    mask[2:12, 4:19] = True
    found = Region(np.array([4, 2, 19, 12], np.float32), np.array([[11, 7]], np.float32), mask, 0.9)
    photo = Image.new("RGB", (30, 20), "grey")
    return Affordance(
        "open the drawer",
        (30, 20),
        imagination=Imagination("a hand pulls the handle", photo),
        target=Target("open the drawer", "drawer", "the handle of the drawer", "It is made to be pulled."),
        regions=(found,),
        image=photo,
    )


def test_everything_is_in_the_recording(tmp_path: Path) -> None:
    recording = rr.RecordingStream("test")
    recording.save(tmp_path / "out.rrd")
    adapter.log(affordance(), recording=recording)
    depth = np.full((20, 30), 0.5)
    adapter.log_lifted(lift(affordance(), depth, Intrinsics(50, 50, 15, 10)), recording=recording)
    recording.flush()
    recording.disconnect()
    written = (tmp_path / "out.rrd").read_bytes()
    for entity in ("image/mask", "image/boxes", "image/points", "imagination", "thinking", "lifted/0/cloud", "0/frame"):
        assert f"/affordance/{entity}".encode() in written or entity.encode() in written, entity
    assert b"It is made to be pulled." in written


def test_contacts_and_grippers_are_in_the_recording(tmp_path: Path) -> None:
    recording = rr.RecordingStream("test")
    recording.save(tmp_path / "out.rrd")
    pose = np.eye(4)
    pose[2, 3] = 0.5
    grasp = Grasp(pose, 0.03, 0.9, np.zeros((2, 2)))
    contact = Contact(np.array([11.0, 7.0]), 4.0, np.array([0, 0, 0.5]), np.array([0, 0, -1.0]), np.array([0, 0, 1.0]))
    unmeasured = Contact(np.array([6.0, 4.0]), 2.0)
    adapter.log_plan(ActionPlan((contact, unmeasured), (grasp,)), recording=recording)
    adapter.log_plan(ActionPlan(()), "nothing", recording=recording)
    recording.flush()
    recording.disconnect()
    written = (tmp_path / "out.rrd").read_bytes()
    for entity in ("affordance/image/contacts", "affordance/contacts", "affordance/grasps/0"):
        assert entity.encode() in written, entity


def test_nothing_found_can_be_logged(tmp_path: Path) -> None:
    recording = rr.RecordingStream("test")
    recording.save(tmp_path / "out.rrd")
    adapter.log(Affordance("open", (30, 20), status="empty"), recording=recording)
    recording.flush()
    recording.disconnect()
    assert b"status: empty" in (tmp_path / "out.rrd").read_bytes()
