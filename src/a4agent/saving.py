"""An answer on disk: affordance.json, mask.png, overlay.png and, when dreamt, imagination.png."""

from __future__ import annotations

import io
import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from a4agent.affordance import Affordance
from a4agent.errors import DataError, InputError
from a4agent.folders import replace_file
from a4agent.images import ANSWER_PICTURES

if TYPE_CHECKING:
    from PIL.Image import Image


def save(affordance: Affordance, folder: Path) -> Path:
    """Write the answer's files into `folder`, which is made; older ones are replaced whole or removed.

    Raises:
        InputError: the folder cannot be written to.
    """
    make_folder(folder)
    pictures = _pictures(affordance)
    text = json.dumps(affordance.to_dict(), ensure_ascii=False, indent=1)
    try:
        for name in ANSWER_PICTURES:
            if name in pictures:
                replace_file(folder / name, _png(pictures[name]))
            else:
                (folder / name).unlink(missing_ok=True)
        # half a surrogate pair (a file name that is not UTF-8) becomes the escape that JSON has for it
        replace_file(folder / "affordance.json", text.encode("utf-8", "backslashreplace"))
    except OSError as error:
        raise InputError(f"cannot write to {str(folder)!r}: {error}; choose another folder with --out") from error
    return folder


def _pictures(affordance: Affordance) -> dict[str, Image]:
    from PIL import Image as Pillow

    from a4agent import overlay

    found: dict[str, Image] = {}
    if affordance.size_wh[0] and affordance.size_wh[1]:
        found["mask.png"] = Pillow.fromarray(affordance.mask.astype(np.uint8) * 255)
    if affordance.image is not None:
        found["overlay.png"] = overlay.draw(affordance.image, affordance)
    if affordance.imagination is not None and affordance.imagination.image is not None:
        found["imagination.png"] = affordance.imagination.image.convert("RGB")
    return found


def _png(image: Image) -> bytes:
    file = io.BytesIO()
    image.save(file, "PNG", compress_level=3)
    return file.getvalue()


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
    except (ValueError, DataError) as error:
        raise DataError(f"{str(path)!r} is not a saved answer: {error}") from error


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
