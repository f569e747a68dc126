"""An answer's folder on disk: affordance.json, mask.png, overlay.png and, when dreamt, imagination.png."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from PIL.Image import Image

from a4agent.errors import InputError
from a4agent.files import replace_file
from a4agent.imaging.encode import encoded
from a4agent.imaging.load import ANSWER_PICTURES


def write_answer(folder: Path, record: Mapping[str, Any], pictures: Mapping[str, Image]) -> Path:
    """Write `record` as affordance.json and the `pictures` by their names of ANSWER_PICTURES; returns the folder.

    The folder is created. Each file is replaced in one step, and pictures of an earlier answer are removed.

    Raises:
        InputError: the folder is not writable.
    """
    make_folder(folder)
    text = json.dumps(record, ensure_ascii=False, indent=1)
    try:
        for name in ANSWER_PICTURES:
            if name in pictures:
                replace_file(folder / name, encoded(pictures[name], "PNG", compress_level=3))
            else:
                (folder / name).unlink(missing_ok=True)
        # A lone surrogate (a file name that is not UTF-8) is written as the escape that JSON has for it.
        replace_file(folder / "affordance.json", text.encode("utf-8", "backslashreplace"))
    except OSError as error:
        raise InputError(f"cannot write to {str(folder)!r}: {error}; choose another folder with --out") from error
    return folder


def make_folder(folder: Path) -> None:
    """Create a folder and check that it is writable.

    Raises:
        InputError: it cannot be created, is a file, or is read-only.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"cannot write to {str(folder)!r}: {error}; choose another folder with --out") from error
