"""Your own pictures: a folder with `samples.jsonl`, or a COCO JSON whose annotations carry instructions.

Licence: yours. Where to get it: draw masks with any tool that writes PNG or COCO; there is no official scorer.

`samples.jsonl` has one row per question, with paths relative to its folder:

    {"id": "mug_02_grasp", "image": "mug_02.jpg", "mask": "mug_02_grasp_mask.png", "instruction": "pick up the mug",
     "object_name": "mug", "object_part": "the handle of the mug", "affordance": "grasp", "category": "mug"}

`id` (default: from the image and the row number) and the last four are optional. `mask` is a picture (foreground is
any value but 0), a COCO RLE object, or a list of these, which are united.

A COCO file is a `.json` with `images`, `annotations` and optional `categories`; the instruction is the annotation's
`caption`. Annotations of one image with the same caption are one sample:

    {"id": 7, "image_id": 1, "category_id": 3, "segmentation": [[10, 10, 50, 10, 50, 40]], "caption": "lift the lid"}
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from a4agent.benchmarks import files
from a4agent.benchmarks.base import Benchmark, Sample, Truth
from a4agent.errors import DataError
from a4agent.types import Query

INDEX = "samples.jsonl"
WORDS = ("object_name", "object_part", "affordance", "category", "answer")


def create(path: str | Path) -> Benchmark:
    """Your own pictures, from a folder or the `.jsonl` or `.json` file in it.

    Raises:
        DataError: no index in the folder, a row that is not as described above, or an id used twice.
    """
    index = _index(Path(path).expanduser())
    rows = read_rows(index) if index.suffix == ".jsonl" else _coco_rows(index)
    return from_rows("folder", index, rows, licence="your own", source="your own files")


def from_rows(
    name: str, index: Path, rows: list[dict[str, Any]], *, licence: str, source: str, revision: str = ""
) -> Benchmark:
    """A benchmark of rows as in `samples.jsonl`, with paths relative to the folder of `index`.

    Raises:
        DataError: an id is used twice.
    """
    root = index.parent.resolve()
    seen: dict[str, int] = {}
    for number, row in enumerate(rows, start=1):
        if row["id"] in seen:
            raise DataError(f"samples {seen[row['id']]} and {number} of {str(index)!r} have the same id {row['id']!r}")
        seen[row["id"]] = number
    named = [part for row in rows for part in (row["image"], *_masks(row)) if isinstance(part, str)]
    return Benchmark(
        name=name,
        licence=licence,
        source=source,
        root=root,
        size=len(rows),
        sample=lambda i: _sample(root, rows[i]),
        digest=files.digest([index.read_bytes(), *(files.sized(root, part) for part in named)]),
        revision=revision,
    )


def _index(path: Path) -> Path:
    if path.is_file():
        return path.resolve()
    root = files.folder(path, "folder")
    if (root / INDEX).is_file():
        return root / INDEX
    found = sorted(root.glob("*.json"))
    if len(found) == 1:
        return found[0]
    raise DataError(
        f"{str(root)!r} holds neither {INDEX!r} nor exactly one COCO .json file (it has {len(found)}); "
        'write one row per line: {"id": ..., "image": ..., "mask": ..., "instruction": ...}'
    )


def read_rows(index: Path) -> list[dict[str, Any]]:
    """The rows of a `samples.jsonl`, each with an id.

    Raises:
        DataError: a row without an image, an instruction or a mask.
    """
    rows: list[dict[str, Any]] = []
    for number, row in files.read_jsonl(index):
        where = f"line {number} of {str(index)!r}"
        for key in ("image", "instruction"):
            if not isinstance(row.get(key), str) or not row[key].strip():
                raise DataError(f"{where} needs a text {key!r}, and has {row.get(key)!r}")
        for mask in _masks(row):
            if not isinstance(mask, (str, dict)):
                raise DataError(f"{where} needs a 'mask': a file name, a COCO RLE or a list of them, not {mask!r:.80}")
        identity = row.get("id", files.row_id(len(rows), row["image"]))
        if not isinstance(identity, (str, int)) or not str(identity).strip():
            raise DataError(f"{where} has an 'id' that is not a text: {identity!r}")
        rows.append({**row, "id": str(identity)})
    return rows


def _coco_rows(index: Path) -> list[dict[str, Any]]:
    data = files.read_json(index)
    try:
        images = {image["id"]: image for image in data["images"]}
        categories = {category["id"]: str(category["name"]) for category in data.get("categories", [])}
        grouped: dict[tuple[Any, str], dict[str, Any]] = {}
        for annotation in data["annotations"]:
            image, caption = images[annotation["image_id"]], annotation.get("caption")
            if not isinstance(caption, str) or not caption.strip():
                raise DataError(f"annotation {annotation['id']} of {str(index)!r} has no instruction as its 'caption'")
            category = categories.get(annotation.get("category_id"), "")
            new = {
                "id": files.row_id(len(grouped), image["file_name"]),
                "image": image["file_name"],
                "instruction": caption,
                "category": category,
                "mask": [],
            }
            row = grouped.setdefault((image["id"], caption), new)
            row["mask"].append(_coco_mask(annotation, image))
        return list(grouped.values())
    except (KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{str(index)!r} is not a COCO file with images and annotations: {error!r}") from error


def _coco_mask(annotation: dict[str, Any], image: dict[str, Any]) -> dict[str, Any]:
    """The annotation's mask as RLE: COCO has polygons (lists of x, y, x, y, ...) and RLE."""
    segmentation = annotation["segmentation"]
    if isinstance(segmentation, dict):
        return cast("dict[str, Any]", segmentation)
    return {"size": [image["height"], image["width"]], "polygons": segmentation}


def _masks(row: dict[str, Any]) -> list[Any]:
    mask = row.get("mask")
    return cast("list[Any]", mask) if isinstance(mask, list) else [mask]


def _sample(root: Path, row: dict[str, Any]) -> Sample:
    words: dict[str, Any] = {key: str(row.get(key) or "") for key in WORDS}
    words["category"] = words["category"] or words["object_name"] or words["affordance"]
    load: Callable[[], np.ndarray] = partial(_union, root, row["id"], _masks(row))
    image = files.confined(root, row["image"])
    return Sample(Query(row["id"], image, row["instruction"]), Truth(load, **words))


def _union(root: Path, identity: str, masks: list[Any]) -> np.ndarray:
    """All masks of a sample as one, (H, W) bool."""
    united: np.ndarray | None = None
    for mask in masks:
        part = _read(root, identity, mask)
        if united is not None and united.shape != part.shape:
            raise DataError(f"the masks of sample {identity!r} have two sizes: {united.shape} and {part.shape}")
        united = part if united is None else united | part
    if united is None:
        raise DataError(f"sample {identity!r} has no mask")
    return united


def _read(root: Path, identity: str, mask: Any) -> np.ndarray:
    if isinstance(mask, str):
        return files.read_mask_in(root, mask)
    where = f"the mask of sample {identity!r}"
    if "polygons" in mask:
        return files.read_polygons(mask["polygons"], mask["size"], where)
    return files.read_rle(mask, where)
