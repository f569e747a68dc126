"""Every declaration compiles, its parts are found and are told apart, and things stand where they should."""

from __future__ import annotations

import numpy as np
import pytest

from a4agent.errors import DataError
from a4agent.sim.catalogue import Catalogue, Part, Selector, Thing, built_in
from a4agent.sim.draw import Plan, draw_sample
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


def test_euler_turns_a_thing_before_it_is_put_down(catalogue: Catalogue) -> None:
    standing = catalogue.thing("thermos")
    for thing, tall in ((standing, True), (standing.model_copy(update={"euler": (90.0, 0.0, 0.0)}), False)):
        scene = _build(catalogue, thing)
        low, high = bounds(scene.model, scene.data, scene.thing_geoms)
        assert low[2] == pytest.approx(0, abs=0.002)
        assert (high[2] > 1.5 * (high[1] - low[1])) == tall


def test_a_custom_catalogue_may_lack_surfaces_and_props(catalogue: Catalogue) -> None:
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
def test_a_declaration_that_does_not_fit_its_file_is_explained(
    catalogue: Catalogue, change: dict[str, object], says: str
) -> None:
    with pytest.raises(DataError, match=says):
        _build(catalogue, catalogue.thing("drawer").model_copy(update=change))
