"""Read the tables that ship inside the package (servers, prices, dialects, the catalogue of models)."""

from __future__ import annotations

import sys
from functools import cache
from importlib import import_module
from importlib.resources import files
from typing import Any

toml: Any = import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")


@cache
def read_toml(package: str, name: str) -> dict[str, Any]:
    """The TOML file `name` of `package`. Read once a process; treat it as read-only."""
    return toml.loads((files(package) / name).read_text(encoding="utf-8"))
