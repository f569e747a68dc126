"""An answer on disk: affordance.json, mask.png, overlay.png and, when dreamt, imagination.png."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import numpy as np

from a4agent.affordance import Affordance
from a4agent.errors import InputError
from a4agent.folders import replace_file


def save(affordance: Affordance, folder: Path) -> Path:
    """Write the answer's files into `folder`, which is made; older ones are replaced whole.

    Raises:
        InputError: the folder cannot be written to.
    """
    from PIL import Image

    from a4agent import overlay

    make_folder(folder)
    try:
        if affordance.size_wh[0] and affordance.size_wh[1]:
            Image.fromarray(affordance.mask.astype(np.uint8) * 255).save(folder / "mask.png")
        if affordance.image is not None:
            overlay.draw(affordance.image, affordance).save(folder / "overlay.png", compress_level=3)
        if affordance.imagination is not None and affordance.imagination.image is not None:
            affordance.imagination.image.save(folder / "imagination.png", compress_level=3)
        write_atomically(folder / "affordance.json", json.dumps(affordance.to_dict(), ensure_ascii=False, indent=1))
    except OSError as error:
        raise InputError(f"cannot write to {str(folder)!r}: {error}; choose another folder with --out") from error
    return folder


def load(folder: Path) -> Affordance:
    """Read an answer that `save` wrote (its pictures stay on disk).

    Raises:
        InputError: there is no such file.
        DataError: it is not an affordance.
    """
    path = folder / "affordance.json"
    try:
        return Affordance.from_dict(json.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise InputError(f"{str(path)!r} cannot be read: {error}") from error


def make_folder(folder: Path) -> None:
    """Make a folder that can be written to.

    Raises:
        InputError: it cannot be made, is a file, or takes no files.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"cannot write to {str(folder)!r}: {error}; choose another folder with --out") from error


def write_atomically(path: Path, text: str) -> None:
    """Replace a file in one step, so that a kill leaves the old one or the new one."""
    replace_file(path, text.encode("utf-8"))
