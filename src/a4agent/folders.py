"""Where this system wants files that can be made again."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def system_cache() -> Path:
    """This package's folder in the system's place for caches; it need not exist."""
    home = Path.home()
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = home / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")
    return base / "a4agent"
