"""Masks that another system wrote, by sample id.

A folder holds, for each id, a picture `<id>.png` ("/" in an id is a folder; foreground is any value but 0), or one
file of COCO RLE for all, or both:

    predictions.json     {"00012-mug": {"size": [480, 640], "counts": "..."}, ...}      id -> RLE or a list of them
    predictions.jsonl    {"id": "00012-mug", "mask": {"size": [480, 640], "counts": "..."}}     one a line

Several masks of one id are united. An id without a mask, or with null for one, is a sample that failed.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, cast

import numpy as np

from a4agent.benchmarks import files
from a4agent.errors import DataError

PICTURES = ".png"


class Predictions:
    """The masks in a folder or in one JSON file, read one at a time.

    Raises:
        DataError: there is nothing at `path`, or a JSON file in it is not as described above.
    """

    def __init__(self, path: str | Path) -> None:
        path = Path(path).expanduser()
        self.path = path
        self._listed: dict[str, list[Any]] = {}
        self._root: Path | None = None
        if path.is_dir():
            self._root = path.resolve()
            for file in self._tables(self._root):
                self._read(file)
        elif path.is_file():
            self._read(path)
        else:
            raise DataError(f"no predictions at {str(path)!r}: a folder with <id>.png, or a .json of COCO RLE by id")

    def mask(self, identity: str) -> np.ndarray | None:
        """The mask (H, W) bool of a sample, None if there is none.

        Raises:
            DataError: there is one and it cannot be read, or masks of one id differ in size.
        """
        where = f"the prediction for {identity!r}"
        masks = [files.read_rle(value, where) for value in self._listed.get(identity, ())]
        picture = self._picture(identity)
        if picture is not None:
            masks.append(files.read_mask(picture))
        if len({mask.shape for mask in masks}) > 1:
            raise DataError(f"{where} has masks of different sizes: {sorted({mask.shape for mask in masks})}")
        return np.logical_or.reduce(masks) if masks else None

    def has(self, identity: str) -> bool:
        """Whether there is a mask for a sample, readable or not."""
        return bool(self._listed.get(identity)) or self._picture(identity) is not None

    def strays(self, known: Iterable[str]) -> list[str]:
        """The ids of predictions that are not `known`, sorted."""
        found = set(self._listed)
        if self._root is not None:
            pictures = self._root.rglob(f"*{PICTURES}")
            found |= {file.relative_to(self._root).as_posix().removesuffix(PICTURES) for file in pictures}
        return sorted(found - set(known))

    def digest(self) -> str:
        """A sha256 over all files."""
        root = self._root or self.path.parent
        found = [self.path] if self._root is None else [*root.rglob(f"*{PICTURES}"), *self._tables(root)]
        named = sorted((file.relative_to(root).as_posix(), file) for file in found)
        return files.digest(part for name, file in named for part in (name, file.read_bytes()))

    @staticmethod
    def _tables(root: Path) -> list[Path]:
        return sorted([*root.glob("*.json"), *root.glob("*.jsonl")])

    def _picture(self, identity: str) -> Path | None:
        if self._root is None:
            return None
        try:
            path = files.confined(self._root, f"{identity}{PICTURES}")
        except DataError:
            return None
        return path if path.is_file() else None

    def _read(self, file: Path) -> None:
        if file.suffix == ".jsonl":
            for number, row in files.read_jsonl(file):
                self._add(row, f"line {number} of {str(file)!r}")
            return
        value = files.read_json(file)
        if isinstance(value, dict):
            for identity, mask in cast("dict[str, Any]", value).items():
                self._add({"id": identity, "mask": mask}, f"{identity!r} in {str(file)!r}")
        elif isinstance(value, list):
            for number, row in enumerate(cast("list[Any]", value)):
                self._add(row, f"entry {number} of {str(file)!r}")
        else:
            raise DataError(f"{str(file)!r} is neither an object of masks by id nor a list of {{'id', 'mask'}}")

    def _add(self, row: Any, where: str) -> None:
        if not isinstance(row, dict) or "id" not in row or "mask" not in row:
            raise DataError(f"{where} needs an 'id' and a 'mask'")
        entry = cast("dict[str, Any]", row)
        masks: list[Any] = entry["mask"] if isinstance(entry["mask"], list) else [entry["mask"]]
        if any(mask is not None and not isinstance(mask, dict) for mask in masks):
            raise DataError(f"{where} needs a COCO RLE as its 'mask', or a list of them, or null")
        self._listed.setdefault(str(entry["id"]), []).extend(mask for mask in masks if mask is not None)
