"""The truth is what a plain renderer of its own sees."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, binary_erosion

from a4agent.sim.backend import mujoco
from a4agent.sim.draw import Drawn
from a4agent.sim.placing import CLEAR
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
