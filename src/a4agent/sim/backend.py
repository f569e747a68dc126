"""MuJoCo, told how to draw without a screen before it is imported."""

from __future__ import annotations

import functools
import os
import sys
from ctypes.util import find_library
from types import ModuleType

from a4agent.errors import require


@functools.cache
def mujoco() -> ModuleType:
    """The `mujoco` module.

    On Linux, unless MUJOCO_GL says otherwise, it renders with OSMesa (in software, the same everywhere)
    where that is installed, else with EGL where there is no display.

    Raises:
        MissingExtraError: it is not installed.
    """
    if sys.platform == "linux" and not os.environ.get("MUJOCO_GL"):
        if find_library("OSMesa"):
            os.environ["MUJOCO_GL"] = "osmesa"
        elif not os.environ.get("DISPLAY"):
            os.environ["MUJOCO_GL"] = "egl"
    return require("mujoco", extra="sim")
