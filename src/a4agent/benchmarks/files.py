"""Reading a dataset's files without trusting it: confined paths, masks, digests, names."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np

from a4agent.errors import A4Error, DataError, InputError
from a4agent.imaging.load import MAX_PIXELS, read_pixels
from a4agent.imaging.masks import decode_rle

MAX_COORDINATES = 1_000_000
"""In all polygons of one mask."""
SMALL = 1 << 18
"""Files of at most this many bytes are hashed whole: most masks, few photographs."""


def folder(path: str | Path, benchmark: str) -> Path:
    """The dataset's folder, resolved.

    Raises:
        DataError: it is not there, or not a folder.
    """
    root = Path(path).expanduser()
    if not root.is_dir():
        what = "is a file" if root.exists() else "does not exist"
        raise DataError(f"{benchmark} needs the folder of the dataset, and {str(root)!r} {what}")
    return root.resolve()


def confined(root: Path, relative: str) -> Path:
    """The file that a dataset names, which must lie below the dataset's `root` (resolved), symlinks followed.

    Raises:
        DataError: the name is absolute, climbs out with `..`, or is a link that leads outside.
    """
    if not relative or "\x00" in relative:
        raise DataError(f"not a file name: {relative!r}")
    try:
        path = (root / relative).resolve()
    except (OSError, RuntimeError, UnicodeError) as error:
        raise DataError(f"the dataset's file name {relative!r} cannot be followed: {error}") from error
    absolute = Path(relative).is_absolute()
    if absolute or not path.is_relative_to(root):
        linked = not absolute and Path(os.path.normpath(root / relative)).is_relative_to(root)
        raise DataError(
            f"the dataset names the file {relative!r}, which {'a link leads out of' if linked else 'is not inside'} "
            f"{str(root)!r}; nothing outside a dataset's own folder is read: copy the file into it"
        )
    return path


def read_mask(path: Path) -> np.ndarray:
    """A mask picture as (H, W) bool: foreground is every pixel whose value is not 0, ignoring alpha.

    Raises:
        DataError: missing, not a picture, cut off, or too large.
    """
    try:
        values = read_pixels(path)
    except InputError as error:
        if isinstance(error.__cause__, FileNotFoundError):
            raise DataError(f"no such mask: {str(path)!r}") from error.__cause__
        raise DataError(f"cannot read the mask: {error}") from error
    if values.ndim == 2:
        return np.not_equal(values, 0)
    mask = np.zeros(values.shape[:2], bool)
    for channel in range(values.shape[2]):  # numpy takes three times as long to reduce a last axis of three
        mask |= np.not_equal(values[..., channel], 0)
    return mask


def read_mask_in(root: Path, relative: str) -> np.ndarray:
    """`read_mask` of a `confined` file: one that the dataset in `root` names."""
    return read_mask(confined(root, relative))


def read_rle(value: Any, where: str) -> np.ndarray:
    """A COCO RLE, compressed or not, as (H, W) bool.

    Raises:
        DataError: it is not a COCO RLE; the message begins with `where`.
    """
    try:
        return decode_rle(value)
    except A4Error as error:
        raise DataError(f"{where}: {error}") from error


def read_polygons(polygons: Any, size_hw: Any, where: str) -> np.ndarray:
    """COCO polygons, [[x, y, x, y, ...], ...] in pixels, filled, as (H, W) bool.

    Raises:
        DataError: they are not COCO polygons; the message begins with `where`.
    """
    from pycocotools import mask

    coco: Any = mask
    try:
        height, width = (int(side) for side in size_hw)
        if height < 1 or width < 1 or height * width > MAX_PIXELS:
            raise ValueError(f"an image of {width} x {height} pixels")
        corners = [[float(value) for value in polygon] for polygon in polygons]
        if any(len(polygon) < 6 or len(polygon) % 2 for polygon in corners):
            raise ValueError("a polygon needs three corners or more, each of two numbers")
        if sum(len(polygon) for polygon in corners) > MAX_COORDINATES:
            raise ValueError(f"more than {MAX_COORDINATES} coordinates")
        for polygon in corners:  # pycocotools allocates every pixel of an edge, also far outside the image
            xy = np.array(polygon).reshape(-1, 2)
            if not ((xy >= [-width, -height]) & (xy <= [2 * width, 2 * height])).all():
                raise ValueError(f"a corner far outside the image of {width} x {height} pixels")
        if not corners:
            return np.zeros((height, width), bool)
        filled = coco.decode(coco.merge(coco.frPyObjects(corners, height, width)))
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{where}: not COCO polygons: {error}") from error
    return filled.astype(bool)


def read_json(path: Path) -> Any:
    """A JSON file's value.

    Raises:
        DataError: missing, or not JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        raise DataError(f"no such file: {str(path)!r}") from error
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{str(path)!r} is not a JSON file: {error}") from error


def read_jsonl(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """Line number and object of each line of a .jsonl file; blank lines are skipped.

    Raises:
        DataError: a line is not a JSON object.
    """
    try:
        with path.open(encoding="utf-8-sig") as file:
            for number, line in enumerate(file, start=1):
                if line.strip():
                    yield number, _object(line, path, number)
    except FileNotFoundError as error:
        raise DataError(f"no such file: {str(path)!r}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{str(path)!r} cannot be read: {error}") from error


def _object(line: str, path: Path, number: int) -> dict[str, Any]:
    try:
        value = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise DataError(f"line {number} of {str(path)!r} is not JSON: {error}") from error
    if not isinstance(value, dict):
        raise DataError(f"line {number} of {str(path)!r} is not a JSON object: {line.strip()[:80]!r}")
    return cast("dict[str, Any]", value)


def digest(parts: Iterable[str | bytes]) -> str:
    """A sha256 over a sequence of texts, each after its length."""
    sha = hashlib.sha256()
    for part in parts:
        raw = part.encode("utf-8", "surrogatepass") if isinstance(part, str) else part
        sha.update(len(raw).to_bytes(8, "big"))
        sha.update(raw)
    return sha.hexdigest()


def sized(root: Path, relative: str) -> str:
    """A file's name and size for a digest, with the hash of its content if it is small; a missing file has size -1."""
    try:
        path = confined(root, relative)
        size = path.stat().st_size
        content = hashlib.sha256(path.read_bytes()).hexdigest() if size <= SMALL else ""
    except (OSError, DataError):
        return f"{relative} -1"
    return f"{relative} {size} {content}"


def row_id(index: int, name: str) -> str:
    """An id that is unique by the row's number and legible by its file's name: "00012-EK_frame_0000040462"."""
    stem = re.sub(r"[^A-Za-z0-9._-]+", "_", Path(name.replace("\\", "/")).stem)[:80].strip("._")
    return f"{index:05d}-{stem}" if stem else f"{index:05d}"
