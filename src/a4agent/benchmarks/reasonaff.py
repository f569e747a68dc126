"""ReasonAff: reasoning questions about affordances over InstructPart's pictures (Affordance-R1). 600 test pairs.

Licence: see the dataset's page. Where to get it: the data set of Affordance-R1 on Hugging Face, saved with
`datasets`' `save_to_disk`; its authors announced a filtered test split in December 2025, so a score names the
revision and the number of rows. Official scorer: Affordance-R1 @d040e27, `evaluation_scripts/` (protocol
`affordance-r1`).

A `DatasetDict` whose split `test` has rows

    {"id": "reasonaff_12", "image": <picture>, "problem": "Which part do I hold to drink safely?",
     "mask": [[False, True, ...], ...], "img_height": 480, "img_width": 640, "mask_h": 480, "mask_w": 640,
     "bboxes": "[[[402, 180], [471, 322]]]", "aff_name": "hold", "part_name": "handle"}

The last two, where present, and `bboxes` and `mask` are answers. Affordance-R1 itself lower-cases `problem` and
strips its end; that is a habit of that model, so the instruction here is `problem` as it stands.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from a4agent.benchmarks import files
from a4agent.benchmarks.base import Benchmark, Sample, Truth
from a4agent.errors import DataError, require
from a4agent.types import Query

STATE = "state.json"
SOURCE = "the data set ReasonAff of Affordance-R1 on Hugging Face, written with save_to_disk (a folder with test/)"


def create(path: str | Path) -> Benchmark:
    """ReasonAff's test split (600); needs the extra `bench`.

    Raises:
        DataError: it is not at `path`, or has other columns.
        MissingExtraError: `datasets` is not installed.
    """
    root = files.folder(path, "reasonaff")
    split = root / "test" if (root / "test").is_dir() else root
    table, shards = _open(root, split)
    missing = [name for name in ("image", "problem", "mask") if name not in table.column_names]
    if missing:
        raise DataError(f"the data set in {str(split)!r} has no column {missing[0]!r}, only {table.column_names}")
    questions = table.select_columns([name for name in table.column_names if name != "mask"])
    masks = table.select_columns(["mask"])
    return Benchmark(
        name="reasonaff",
        licence="see the dataset's page",
        source=SOURCE,
        root=root,
        size=len(table),
        sample=lambda i: _sample(root, questions, masks, i),
        digest=files.digest([(split / STATE).read_bytes(), *(files.sized(root, shard) for shard in shards)]),
        revision=str(files.read_json(split / STATE).get("_fingerprint", "")),
        published_protocol="affordance-r1",
        expected=600,
    )


def _open(root: Path, split: Path) -> tuple[Any, list[str]]:
    """The saved split, read from disk row by row, undecoded, and the names of its files below `root`."""
    datasets = cast(Any, require("datasets", extra="bench"))
    if not (split / STATE).is_file():
        raise DataError(f"{str(root)!r} holds no split 'test' written with save_to_disk. Where to get it: {SOURCE}")
    try:
        named = [split / shard["filename"] for shard in files.read_json(split / STATE)["_data_files"]]
        shards = [path.relative_to(root).as_posix() for path in named]
        for shard in shards:
            files.confined(root, shard)
        return datasets.Dataset.load_from_disk(str(split)).with_format("arrow"), shards
    except DataError:
        raise
    except Exception as error:  # pyarrow and datasets raise errors of many kinds for a damaged folder
        raise DataError(f"{str(split)!r} cannot be read as a data set: {error!r}. Where to get it: {SOURCE}") from error


def _sample(root: Path, questions: Any, masks: Any, number: int) -> Sample:
    row: dict[str, Any] = questions[number].to_pylist()[0]
    part, affordance = str(row.get("part_name") or ""), str(row.get("aff_name") or "")
    return Sample(
        Query(files.row_id(number, str(row.get("id", ""))), _picture(root, row["image"], number), str(row["problem"])),
        Truth(partial(_mask, masks, number), object_part=part, affordance=affordance, category=affordance or part),
    )


def _picture(root: Path, stored: Any, number: int) -> bytes | Path:
    """The picture's file: its bytes where the table holds them, its path within the data set otherwise."""
    stored = stored or {}
    if stored.get("bytes"):
        return stored["bytes"]
    if stored.get("path"):
        return files.confined(root, stored["path"])
    raise DataError(f"row {number} of reasonaff has no picture")


def _mask(masks: Any, number: int) -> np.ndarray:
    rows = masks[number].column("mask").combine_chunks()
    try:
        lengths = rows.flatten().value_lengths().to_numpy(zero_copy_only=False)
        values = rows.flatten().flatten().to_numpy(zero_copy_only=False)
        if len(set(lengths.tolist())) != 1:
            raise ValueError(f"its lines have {len(set(lengths.tolist()))} lengths")
        return values.reshape(len(lengths), -1) != 0
    except (ValueError, AttributeError, TypeError) as error:
        raise DataError(f"the mask of row {number} of reasonaff is not a rectangle of values: {error}") from error
