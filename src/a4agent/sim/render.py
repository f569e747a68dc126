"""The renderer: a picture, the renderer's own ids, and depth, all from the scene's camera."""

from __future__ import annotations

import numpy as np

from a4agent.sim.appearance import Camera
from a4agent.sim.backend import mujoco, renderer
from a4agent.sim.placing import CLEAR, PART, SOLID
from a4agent.sim.scene import EYE, Scene

GEOM = 5
"""mjOBJ_GEOM: the kind of thing an id of the segmentation picture refers to."""


class SceneRenderer:
    """Renders one scene at one wide size. A context manager: graphics memory is given back at the end.

    Raises:
        ResourceError: no off-screen renderer works on this machine; says how to get one.
    """

    def __init__(self, scene: Scene, wide_wh: tuple[int, int]) -> None:
        self._scene = scene
        self._renderer = renderer(scene.model, wide_wh)

    def __enter__(self) -> SceneRenderer:
        return self

    def __exit__(self, *_: object) -> None:
        self._renderer.close()

    def colour(self, camera: Camera) -> np.ndarray:
        """The picture in the camera's window, (H, W, 3) uint8."""
        self._renderer.disable_depth_rendering()
        self._renderer.disable_segmentation_rendering()
        return camera.crop(self._shoot((SOLID, CLEAR, PART)))

    def ids(self, camera: Camera) -> np.ndarray:
        """The geom seen in each pixel of the camera's window, (H, W) int32; -1 where there is none.

        What lies behind glass is seen through it.
        """
        return camera.crop(self._ids((SOLID, PART)))

    def part_alone(self) -> np.ndarray:
        """Like `ids`, with nothing but the asked parts in the scene and of the whole wide picture."""
        return self._ids((PART,))

    def depth(self, camera: Camera) -> np.ndarray:
        """Metres along the camera's axis in the camera's window, (H, W) float32; 0 where there is nothing."""
        self._renderer.enable_depth_rendering()
        return camera.crop(self._shoot((SOLID, PART))).astype(np.float32)

    def _ids(self, groups: tuple[int, ...]) -> np.ndarray:
        self._renderer.enable_segmentation_rendering()
        pair = self._shoot(groups)
        return np.where(pair[..., 1] == GEOM, pair[..., 0], -1).astype(np.int32)

    def _shoot(self, groups: tuple[int, ...]) -> np.ndarray:
        option = mujoco().MjvOption()
        option.geomgroup[:] = 0
        option.geomgroup[list(groups)] = 1
        option.sitegroup[:] = 0
        self._renderer.update_scene(self._scene.data, EYE, option)
        return self._renderer.render()
