"""Files on disk: the cache folder, replacing a file in one step, and reading TOML."""

from __future__ import annotations

import os
import re
import sys
import uuid
from contextlib import suppress
from functools import cache
from importlib import import_module
from importlib.resources import files as package_files
from pathlib import Path
from typing import Any

from platformdirs import user_cache_path

from a4agent.errors import ConfigError

toml: Any = import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")

DRAFT = re.compile(r"\.[0-9a-f]{32}\.tmp")


def system_cache() -> Path:
    """This package's folder in the system's place for caches; it need not exist."""
    return user_cache_path("a4agent", appauthor=False)


def replace_file(path: Path, data: bytes, *, durable: bool = False) -> None:
    """Put `data` at `path` in one step: a reader, also after a kill, sees the old content or the new one.

    The folder is created. With `durable` the data is on the disk when this returns.

    Raises:
        OSError: it cannot be written; the old file is unchanged and no draft is left.
    """
    draft = path.with_name(f".{uuid.uuid4().hex}.tmp")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with draft.open("wb") as file:
            file.write(data)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        os.replace(draft, path)
    except BaseException:
        with suppress(OSError):
            draft.unlink()
        raise


def is_draft(path: Path) -> bool:
    """Whether `replace_file` is writing this file, or a killed process left it behind."""
    return DRAFT.fullmatch(path.name) is not None


def read_toml(path: Path) -> dict[str, Any]:
    """The contents of a TOML file.

    Raises:
        ConfigError: it cannot be read or is not TOML.
    """
    try:
        return toml.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot read {str(path)!r}: {error}") from error
    except toml.TOMLDecodeError as error:
        raise ConfigError(f"{str(path)!r} is not valid TOML: {error}") from error


@cache
def read_package_toml(package: str, name: str) -> dict[str, Any]:
    """The TOML file `name` that ships inside `package`. Read once a process; treat it as read-only."""
    return toml.loads((package_files(package) / name).read_text(encoding="utf-8"))
