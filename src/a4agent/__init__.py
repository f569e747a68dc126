"""Which part of the thing in this picture do I act on?

from a4agent import A4Agent
affordance = A4Agent.from_profile("offline").predict("mug.jpg", "drink from the mug")
affordance.target.object_part, affordance.mask, affordance.boxes_xyxy, affordance.points_xy
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from a4agent import errors
    from a4agent.agent import A4Agent
    from a4agent.imaging.load import load_image
    from a4agent.types import Affordance, Check, Given, Imagination, Query, Region, Target, Trace

__version__ = "0.2.0"
__all__ = [
    "A4Agent",
    "Affordance",
    "Check",
    "Given",
    "Imagination",
    "Query",
    "Region",
    "Target",
    "Trace",
    "errors",
    "load_image",
]

_HOME = {
    "A4Agent": "agent",
    "Affordance": "types",
    "Check": "types",
    "Given": "types",
    "Imagination": "types",
    "Query": "types",
    "Region": "types",
    "Target": "types",
    "Trace": "types",
    "load_image": "imaging.load",
}


def __getattr__(name: str) -> Any:
    """The public names are imported when they are first used, so that `import a4agent` costs nothing."""
    if name in _HOME:
        return getattr(importlib.import_module(f"a4agent.{_HOME[name]}"), name)
    try:
        return importlib.import_module(f"a4agent.{name}")
    except ModuleNotFoundError as error:
        if error.name != f"a4agent.{name}":
            raise
        raise AttributeError(f"module 'a4agent' has no attribute {name!r}") from None


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
