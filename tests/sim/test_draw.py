"""The truth of a picture, checked against the renderer in ways that the maker does not use."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, binary_erosion

from a4agent.errors import ConfigError, DataError
from a4agent.sim import draw
from a4agent.sim.backend import mujoco
from a4agent.sim.catalogue import Catalogue
from a4agent.sim.draw import LEAST_PIXELS, LEAST_VISIBLE, Drawn, Plan, draw_sample, plan_set
from a4agent.sim.placing import CLEAR, bounds
from a4agent.sim.scene import EYE

NAMES = ["drawer", "sink cabinet", "dial"]


def _render(drawn: Drawn, *, ids: bool) -> np.ndarray:
    """With a renderer of its own, without shadows, reflections and the sensor."""
    scene, camera = drawn.scene, drawn.camera
    width, height = camera.wide_wh
    renderer = mujoco().Renderer(scene.model, height, width)
    option = mujoco().MjvOption()
    option.geomgroup[:] = [1, 1, 1, not ids, 0, 1]
    option.sitegroup[:] = 0
    renderer.update_scene(scene.data, EYE, option)
    renderer.scene.flags[mujoco().mjtRndFlag.mjRND_SHADOW] = 0
    renderer.scene.flags[mujoco().mjtRndFlag.mjRND_REFLECTION] = 0
    if ids:
        renderer.enable_segmentation_rendering()
    picture = renderer.render()
    renderer.close()
    return camera.crop(picture[..., 0] if ids else picture)


@pytest.mark.parametrize("name", NAMES)
def test_the_mask_is_where_the_renderer_sees_the_parts_geoms(drawn: dict[str, Drawn], name: str) -> None:
    sample = drawn[name]
    seen = _render(sample, ids=True)
    for number, geoms in enumerate(sample.scene.part_geoms.values(), start=1):
        assert ((sample.regions == number) == np.isin(seen, geoms)).all()
    assert (sample.thing == np.isin(seen, sample.scene.thing_geoms)).all()


@pytest.mark.parametrize("name", NAMES)
def test_the_mask_is_what_changes_when_the_part_is_painted(drawn: dict[str, Drawn], name: str) -> None:
    sample = drawn[name]
    model = sample.scene.model
    part = np.concatenate(list(sample.scene.part_geoms.values()))
    before = _render(sample, ids=False).astype(int)
    kept = model.geom_matid[part].copy(), model.geom_rgba[part].copy()
    model.geom_matid[part], model.geom_rgba[part] = -1, (1, 0, 1, 1)
    after = _render(sample, ids=False).astype(int)
    model.geom_matid[part], model.geom_rgba[part] = kept
    changed = np.abs(after - before).max(2) > 0
    mask = sample.regions > 0
    clear = np.isin(sample.scene.model.geom_group, [CLEAR]).any()
    assert not (changed & ~binary_dilation(mask, iterations=2)).any() or clear
    assert changed[binary_erosion(mask, iterations=2)].mean() > 0.98


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


def test_the_shares_add_up(drawn: dict[str, Drawn]) -> None:
    for sample in drawn.values():
        shares = sample.shares
        assert shares.visible + shares.occluded + shares.cut == pytest.approx(1)
        assert min(shares.visible, shares.occluded, shares.cut) >= 0
        assert shares.visible >= LEAST_VISIBLE
        assert (sample.regions > 0).sum() >= LEAST_PIXELS


def test_a_plan_draws_the_same_sample_again(catalogue: Catalogue, drawn: dict[str, Drawn]) -> None:
    again = draw_sample(catalogue, drawn["dial"].plan)
    for field in ("image", "regions", "thing", "depth"):
        assert np.array_equal(getattr(again, field), getattr(drawn["dial"], field))


def test_a_part_that_only_shows_from_behind_is_never_emitted(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(draw, "SCENES", 3)
    drawer = catalogue.thing("drawer")
    hidden = drawer.model_copy(update={"front": 90.0, "spread": 2.0, "joints": {}, "elevation": (5.0, 10.0)})
    with pytest.raises(DataError, match="'drawer': the part 'handle' was hidden or tiny in all"):
        draw_sample(catalogue, Plan(0, 0, hidden, hidden.tasks[0]))


def test_all_things_come_before_any_comes_again(catalogue: Catalogue) -> None:
    for split in ("dev", "test", None):
        names = [thing.name for thing in catalogue.split(split)]
        plans = list(plan_set(catalogue, 4 * len(names), 11, split))
        for turn in range(4):
            shown = [plan.thing.name for plan in plans[turn * len(names) : (turn + 1) * len(names)]]
            assert sorted(shown) == sorted(names)
        for name in names:
            tasks = [plan.task for plan in plans if plan.thing.name == name]
            assert len({task.say for task in tasks}) == len(catalogue.thing(name).tasks)


def test_a_larger_set_begins_like_a_smaller_one(catalogue: Catalogue) -> None:
    assert list(plan_set(catalogue, 50, 2, "test"))[:10] == list(plan_set(catalogue, 10, 2, "test"))


def test_files_are_named_after_any_thing(catalogue: Catalogue) -> None:
    thing = catalogue.thing("drawer")
    for name, stem in (("box lid", "0007-box-lid"), ("../a/b: Tür", "0007--a-b-Tür")):
        assert Plan(0, 7, thing.model_copy(update={"name": name}), thing.tasks[0]).stem == stem


def test_an_empty_split_is_refused(catalogue: Catalogue) -> None:
    only_dev = catalogue.model_copy(update={"things": catalogue.split("dev")})
    with pytest.raises(ConfigError, match="no thing is declared for the split 'test'"):
        list(plan_set(only_dev, 3, 0, "test"))


def _lift(sample: Drawn, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    depth = sample.depth[rows, columns]
    pixels = np.stack([columns, rows, np.ones(len(rows))])
    camera = np.linalg.inv(sample.camera.matrix) @ pixels * depth
    return (sample.camera.pose[:3, :3] @ camera).T + sample.camera.pose[:3, 3]
