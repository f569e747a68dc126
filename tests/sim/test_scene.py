"""Every declaration compiles, its parts are found and are told apart, and things stand where they should."""

from __future__ import annotations

import numpy as np
import pytest

from a4agent.errors import DataError
from a4agent.sim.catalogue import Catalogue, Part, Selector, Thing, built_in
from a4agent.sim.draw import Drawn, Plan, draw_sample
from a4agent.sim.placing import UNSEEN, bounds
from a4agent.sim.scene import build_scene


def _build(catalogue: Catalogue, thing: Thing, **options: object) -> object:
    return build_scene(catalogue, thing, list(thing.parts), yaw=0.0, rng=np.random.default_rng(0), **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", [thing.name for thing in built_in().things])
def test_the_parts_of_a_thing_are_found_and_share_no_geom(catalogue: Catalogue, name: str) -> None:
    scene = _build(catalogue, catalogue.thing(name))
    found = np.concatenate(list(scene.part_geoms.values()))
    assert len(set(found.tolist())) == len(found)
    assert set(found.tolist()) <= set(scene.thing_geoms.tolist())
    assert not (scene.model.geom_group[scene.thing_geoms] == UNSEEN).any()


def test_things_and_props_stand_on_the_table_and_not_in_each_other(catalogue: Catalogue) -> None:
    thing = catalogue.thing("thermos")
    scene = _build(catalogue, thing, props=catalogue.props[:5])
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


def test_euler_turns_a_thing_before_it_is_put_down(catalogue: Catalogue) -> None:
    standing = catalogue.thing("thermos")
    for thing, tall in ((standing, True), (standing.model_copy(update={"euler": (90.0, 0.0, 0.0)}), False)):
        scene = _build(catalogue, thing)
        low, high = bounds(scene.model, scene.data, scene.thing_geoms)
        assert low[2] == pytest.approx(0, abs=0.002)
        assert (high[2] > 1.5 * (high[1] - low[1])) == tall


def test_a_catalogue_of_ones_own_need_not_declare_surfaces_or_props(catalogue: Catalogue) -> None:
    for surfaces in ((), tuple(one for one in catalogue.surfaces if one.use == ("table",))):
        bare = catalogue.model_copy(update={"surfaces": surfaces, "props": (), "arms": ()})
        drawn = draw_sample(bare, Plan(1, 0, bare.thing("drawer"), bare.thing("drawer").tasks[0]))
        assert drawn.scene.surfaces == (("table",) if surfaces else ())


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"root": "wardrobe"}, "has no body, geom or mesh 'wardrobe'"),
        ({"root": None}, "say which one with `root`"),
        ({"joints": {"hinge_9": (0.0, 1.0)}}, "has no joint 'hinge_9'"),
        ({"parts": {"handle": Part(phrase="x", geoms=(Selector(mesh="nothing"),))}}, "no geom of 'drawer' matches"),
        ({"in_place": True, "without": ("nobody",)}, "has no body 'nobody' to leave out"),
    ],
)
def test_a_declaration_that_does_not_fit_its_file_says_so(
    catalogue: Catalogue, change: dict[str, object], says: str
) -> None:
    with pytest.raises(DataError, match=says):
        _build(catalogue, catalogue.thing("drawer").model_copy(update=change))


def test_a_selector_matches_all_its_fields(drawn: dict[str, Drawn]) -> None:
    from a4agent.sim.placing import match_geoms

    scene = drawn["drawer"].scene
    everything = range(scene.model.ngeom)
    handle = match_geoms(scene.model, everything, [Selector(mesh="drawerhandle")], "thing/")
    assert handle.tolist() == scene.part_geoms["handle"].tolist()
    assert len(match_geoms(scene.model, everything, [Selector(mesh="drawerhandle", type="box")], "thing/")) == 0
    both = match_geoms(scene.model, everything, [Selector(mesh="drawerhandle"), Selector(mesh="drawercase")], "thing/")
    assert len(both) == 2


def _below(model: object, geom: int, body_name: str) -> bool:
    body = model.geom_bodyid[geom]  # type: ignore[attr-defined]
    while body:
        if model.body(body).name == body_name:  # type: ignore[attr-defined]
            return bool(model.geom_group[geom] != UNSEEN)  # type: ignore[attr-defined]
        body = model.body_parentid[body]  # type: ignore[attr-defined]
    return False
