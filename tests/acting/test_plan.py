"""Plans: complete with depth, honest without, JSON-safe, and drawn where they belong."""

from __future__ import annotations

import json

import numpy as np
from PIL import Image

from a4agent.acting.lifting import Intrinsics
from a4agent.acting.plan import draw_plan, plan_action
from a4agent.types import Affordance, Region

CAMERA = Intrinsics(500.0, 500.0, 159.5, 119.5)
MASK = np.zeros((240, 320), bool)
MASK[105:135, 80:240] = True
DEPTH = np.where(MASK, 0.5, 0.55)


def answer(mask: np.ndarray) -> Affordance:
    regions = (Region(None, np.zeros((0, 2), np.float32), mask),)
    return Affordance("take it", (320, 240), regions=regions)


def test_with_depth_it_is_complete() -> None:
    plan = plan_action(answer(MASK), depth=DEPTH, camera=CAMERA)
    assert plan.grasps
    assert plan.reason == ""
    row = json.loads(json.dumps(plan.to_dict()))
    assert len(row["grasps"][0]["pose"]) == 4
    assert row["contacts"][0]["position_xyz"][2] == 0.5


def test_what_is_missing_has_a_reason() -> None:
    assert plan_action(answer(np.zeros_like(MASK))).reason == "no part was found"
    without = plan_action(answer(MASK))
    assert without.contacts
    assert "depth image" in without.reason
    blind = plan_action(answer(MASK), depth=np.full(MASK.shape, np.nan), camera=CAMERA)
    assert blind.reason == "no depth was measured on the part"
    assert json.loads(json.dumps(blind.to_dict()))["contacts"][0]["position_xyz"] is None
    flat = plan_action(answer(MASK), depth=np.full(MASK.shape, 0.5), camera=CAMERA)
    assert "free beside" in flat.reason


def test_the_gripper_is_drawn_at_the_part() -> None:
    plan = plan_action(answer(MASK), depth=DEPTH, camera=CAMERA)
    drawn = np.asarray(draw_plan(Image.new("RGB", (320, 240), "white"), plan, CAMERA)).astype(int)
    changed = np.abs(drawn - 255).sum(2) > 60
    rows, columns = np.nonzero(changed)
    assert changed.any()
    assert abs(columns.mean() - 160) < 40
    assert 60 < rows.mean() < 180
