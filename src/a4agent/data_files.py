"""Read the tables that ship inside the package (servers, prices, dialects, the catalogue of models)."""

from __future__ import annotations

import sys
from functools import cache
from importlib.resources import files
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:  # pragma: no cover
    import tomli as tomllib


@cache
def read_toml(package: str, name: str) -> dict[str, Any]:
    """The TOML file `name` of `package`. Read once a process; treat it as read-only."""
    return tomllib.loads((files(package) / name).read_text(encoding="utf-8"))
