"""RAGNet's reasoning sets: questions about grasping over photos of 3DOI and HANDAL (arXiv 2507.23734).

Licence: see the dataset's page; the HANDAL pictures are CC-BY-NC-SA-4.0.
Where to get it: the data set `Dongming97/RAGNet` on Hugging Face, `data.zip` (37.7 GB). HANDAL's pictures are not
in it: the 17 `without_depth` archives of NVlabs/HANDAL go to `HANDAL/without_depth` (about 90 GB).
Official scorer: AffordanceNet @bf5a171, `train_aff.py`; its evaluation puts `answer`, the reference, into the
prompt. Here `answer` is part of the hidden half, and the instruction is `question` as it stands.

Each set is a pickle, a list of

    {"frame_path": "./data/3doi/images/EK_frame_0000012345.jpg", "mask_path": "./data/3doi/masks/....png",
     "question": "I want to cut the bread. ...", "answer": "...", "task_object_class": "knife"}

Paths begin with `./data/`, which is the folder of the pickles. A mask's foreground is any value above 0. HANDAL's
`rgb/X.jpg` goes with `mask_parts/X_000000_handle.png`, whose name is the only mention of the part.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, cast

from a4agent.benchmarks import files, pickles
from a4agent.benchmarks.base import Benchmark, Sample, Truth
from a4agent.errors import DataError
from a4agent.types import Query

BROKEN_FRAME = "EK_frame_0000040462.jpg"
"""The one picture of 3DOI that cannot be decoded; the published counts leave it out."""

DATA = "data set Dongming97/RAGNet on Hugging Face: data.zip (37.7 GB), unpacked"
HANDAL = (
    f"{DATA}; pictures from NVlabs/HANDAL: the 17 without_depth archives, in HANDAL/without_depth next to the pickles"
)


def create_3doi(path: str | Path) -> Benchmark:
    """RAGNet-3DOI, easy questions (1,012).

    Raises:
        DataError: it is not at `path`, or its pickle is not a plain list of questions.
    """
    return _open("ragnet-3doi", path, "3doi_easy_reasoning_val.pkl", 1012, "see the dataset's page", DATA)


def create_handal_easy(path: str | Path) -> Benchmark:
    """RAGNet-HANDAL, easy questions (1,003).

    Raises:
        DataError: it is not at `path`, or its pickle is not a plain list of questions.
    """
    return _open("ragnet-handal-easy", path, "handal_easy_reasoning_val.pkl", 1003, "CC-BY-NC-SA-4.0", HANDAL)


def create_handal_hard(path: str | Path) -> Benchmark:
    """RAGNet-HANDAL, hard questions (1,003).

    Raises:
        DataError: it is not at `path`, or its pickle is not a plain list of questions.
    """
    return _open("ragnet-handal-hard", path, "handal_hard_reasoning_val.pkl", 1003, "CC-BY-NC-SA-4.0", HANDAL)


@dataclass(frozen=True)
class _PickledRow:
    number: int  # in the pickle, so that ids stay when a row is left out
    frame: str
    mask: str
    question: str
    answer: str
    object_class: str


def _open(name: str, path: str | Path, pickle_name: str, expected: int, licence: str, source: str) -> Benchmark:
    root = files.folder(path, name)
    if not (root / pickle_name).is_file() and (root / "data" / pickle_name).is_file():
        root = root / "data"
    if not (root / pickle_name).is_file():
        raise DataError(f"{name} needs the file {pickle_name!r} in {str(root)!r}. Where to get it: {source}")
    rows = _rows(root / pickle_name)
    return Benchmark(
        name=name,
        licence=licence,
        source=source,
        root=root,
        size=len(rows),
        sample=lambda i: _sample(root, rows[i]),
        digest=files.digest(
            [(root / pickle_name).read_bytes(), *(files.sized(root, part) for r in rows for part in (r.frame, r.mask))]
        ),
        published_protocol="ragnet",
        expected=expected,
    )


def _rows(path: Path) -> list[_PickledRow]:
    value = pickles.load(path)
    if not isinstance(value, list):
        raise DataError(f"{str(path)!r} holds a {type(value).__name__}, not a list of questions")
    rows: list[_PickledRow] = []
    for number, entry in enumerate(cast("list[Any]", value)):
        try:
            row = _PickledRow(
                number=number,
                frame=_relative(_text(entry, "frame_path")),
                mask=_relative(_text(entry, "mask_path")),
                question=_text(entry, "question"),
                answer=_text(entry, "answer", ""),
                object_class=_text(entry, "task_object_class", ""),
            )
        except (KeyError, TypeError, AttributeError) as error:
            raise DataError(f"row {number} of {str(path)!r} is not a question: {error!r:.200}") from error
        if PurePosixPath(row.frame).name != BROKEN_FRAME:
            rows.append(row)
    return rows


def _text(entry: Any, key: str, default: str | None = None) -> str:
    value = entry[key] if default is None else entry.get(key, default)
    if not isinstance(value, str):
        raise TypeError(f"{key!r} must be a text, not {type(value).__name__}")
    return value


def _relative(name: str) -> str:
    """ "./data/3doi/images/x.jpg" -> "3doi/images/x.jpg"."""
    return name.removeprefix("./").removeprefix("data/")


def _sample(root: Path, row: _PickledRow) -> Sample:
    return Sample(
        Query(files.row_id(row.number, row.frame), files.confined(root, row.frame), row.question),
        Truth(
            partial(files.read_mask_in, root, row.mask),
            object_name=row.object_class,
            object_part=_part(row),
            category=row.object_class,
            answer=row.answer,
        ),
    )


def _part(row: _PickledRow) -> str:
    """ "the handle of the hammer" from HANDAL's `X_000000_handle.png`; "" for 3DOI, which names no parts."""
    found = re.search(r"/mask_parts/.*_\d{6}_([a-z_]+)\.png$", row.mask)
    return f"the {found[1].replace('_', ' ')} of the {row.object_class}" if found else ""
