"""Things stand where they should, joints keep to their ranges, and selectors tell geoms apart."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from a4agent.sim.catalogue import Catalogue, Selector
from a4agent.sim.draw import Drawn
from a4agent.sim.placing import UNSEEN, bounds, match_geoms
from a4agent.sim.scene import build_scene


def test_things_and_props_stand_on_the_table_and_not_in_each_other(catalogue: Catalogue) -> None:
    thing = catalogue.thing("thermos")
    scene = build_scene(
        catalogue, thing, list(thing.parts), props=catalogue.props[:5], yaw=0.0, rng=np.random.default_rng(0)
    )
    low, high = bounds(scene.model, scene.data, scene.thing_geoms)
    assert low[2] == pytest.approx(0, abs=0.002)
    boxes = [(low, high)]
    assert scene.props
    for index, prop in enumerate(catalogue.props[:5]):
        if prop.name in scene.props:
            inside = [g for g in range(scene.model.ngeom) if _below(scene.model, g, f"prop{index}")]
            boxes.append(bounds(scene.model, scene.data, np.array(inside)))
            assert boxes[-1][0][2] == pytest.approx(0, abs=0.002)
    for i, (a_low, a_high) in enumerate(boxes):
        for b_low, b_high in boxes[:i]:
            assert ((a_high[:2] < b_low[:2]) | (b_high[:2] < a_low[:2])).any()


def test_joints_stay_in_their_range(catalogue: Catalogue) -> None:
    thing = catalogue.thing("drawer")
    opened = set()
    for seed in range(4):
        scene = build_scene(catalogue, thing, ["handle"], yaw=0.0, rng=np.random.default_rng(seed))
        position = float(scene.data.joint("thing/goal_slidey").qpos[0])
        assert -0.12 <= position <= 0
        opened.add(position)
    assert len(opened) == 4


def test_a_selector_matches_all_its_fields(drawn: dict[str, Drawn]) -> None:
    scene = drawn["drawer"].scene
    everything = range(scene.model.ngeom)
    handle = match_geoms(scene.model, everything, [Selector(mesh="drawerhandle")], "thing/")
    assert handle.tolist() == scene.part_geoms["handle"].tolist()
    assert len(match_geoms(scene.model, everything, [Selector(mesh="drawerhandle", type="box")], "thing/")) == 0
    both = match_geoms(scene.model, everything, [Selector(mesh="drawerhandle"), Selector(mesh="drawercase")], "thing/")
    assert len(both) == 2


def _below(model: Any, geom: int, body_name: str) -> bool:
    body = model.geom_bodyid[geom]
    while body:
        if model.body(body).name == body_name:
            return bool(model.geom_group[geom] != UNSEEN)
        body = model.body_parentid[body]
    return False
