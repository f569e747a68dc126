"""The scene of a task: Meta-World's own, or one of its scenes with a thing of another package in it."""

from __future__ import annotations

from typing import Any

import numpy as np

from a4agent.errors import DataError
from a4agent.sim.act_tasks import ActTask
from a4agent.sim.assets import asset_path
from a4agent.sim.backend import mujoco
from a4agent.sim.catalogue import built_in
from a4agent.sim.scene import drop_unused, same_physics


def load_scene(task: ActTask) -> Any:
    """The compiled model of the task's scene.

    Raises:
        MissingExtraError: mujoco or an asset package is not installed.
        DataError: a file of a package does not hold what the task says.
    """
    path = str(asset_path(built_in(), "metaworld", f"sawyer_xyz/{task.model}"))
    if task.guest is None:
        return mujoco().MjModel.from_xml_path(path)
    guest = task.guest
    spec = mujoco().MjSpec.from_file(path)
    child = mujoco().MjSpec.from_file(str(asset_path(built_in(), guest.package, guest.file)))
    host, root = spec.body(guest.instead_of), child.body(guest.root)
    if host is None or root is None:
        raise DataError(
            f"{task.name!r} needs a body {guest.instead_of!r} in {task.model!r} and {guest.root!r} in {guest.file!r}"
        )
    spec.delete(host)
    same_physics(child, spec)
    root.pos = np.zeros(3)
    spec.worldbody.add_body(name=task.thing).add_frame().attach_body(root, f"{task.thing}/", "")
    drop_unused(spec, f"{task.thing}/")
    return spec.compile()
