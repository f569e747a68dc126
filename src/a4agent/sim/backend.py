"""MuJoCo, told how to draw without a screen before it is imported."""

from __future__ import annotations

import functools
import os
import sys
from ctypes.util import find_library
from types import ModuleType
from typing import Any

from a4agent.errors import ResourceError, require


@functools.cache
def mujoco() -> ModuleType:
    """The `mujoco` module.

    On Linux, unless MUJOCO_GL says otherwise, it renders with OSMesa (in software, the same everywhere)
    where that is installed, else with EGL where there is no display.

    Raises:
        MissingExtraError: it is not installed.
        ResourceError: it finds no way to render off-screen.
    """
    if sys.platform == "linux" and not os.environ.get("MUJOCO_GL"):
        if find_library("OSMesa"):
            os.environ["MUJOCO_GL"] = "osmesa"
        elif not os.environ.get("DISPLAY"):
            os.environ["MUJOCO_GL"] = "egl"
    try:
        return require("mujoco", extra="sim")
    except (ImportError, AttributeError, RuntimeError) as error:
        raise _no_renderer(error) from error


def renderer(model: Any, size_wh: tuple[int, int]) -> Any:
    """A `mujoco.Renderer` for pictures of this size; close it after use.

    Raises:
        ResourceError: no off-screen renderer works on this machine; says how to get one.
    """
    width, height = size_wh
    try:
        return mujoco().Renderer(model, height, width)
    except (ImportError, AttributeError, RuntimeError, mujoco().FatalError) as error:
        raise _no_renderer(error) from error


def check_renderer() -> str:
    """Render an empty picture; returns what renders it ("osmesa", "egl", ... or "" for the system's own).

    Raises what `mujoco` and `renderer` raise.
    """
    one = renderer(mujoco().MjModel.from_xml_string("<mujoco/>"), (8, 8))
    one.render()
    one.close()
    return os.environ.get("MUJOCO_GL", "")


def _no_renderer(error: Exception) -> ResourceError:
    return ResourceError(
        f"mujoco cannot render off-screen here ({error}). Install OSMesa (Debian: apt install libosmesa6) and set "
        f"MUJOCO_GL=osmesa, or MUJOCO_GL=egl with a GPU, before Python starts; "
        f"it is {os.environ.get('MUJOCO_GL', '')!r} now"
    )
