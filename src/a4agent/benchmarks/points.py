"""Benchmarks that ask for points: Where2Place, RefSpatial-Bench, RoboAfford-Eval, VABench-P, Part-Affordance-2K, PIO.

A sample is a picture, a question and a mask of where a point may lie. They are scored by the contact-point hit rate
(which `a4 bench` prints for every benchmark): the share of a sample's points inside the mask, averaged over samples.
IoU is printed too but means little: the mask holds every right point, and one is enough. The tag `kind` separates free
places (`placement`) from objects and parts.

**Where2Place** (100 questions about free space; see its page for the licence). Where to get it:
`wentao-yuan/where2place` on Hugging Face: `point_questions.jsonl`, `images/`, `masks/`. Official scorer: RoboPoint
@9d54aac, `robopoint/eval/summarize_vqa.py`: the i-th line of the questions goes with `masks/%02d.jpg` of i, and a
point scores the mask's grey value over 255, so that pixels blurred by JPEG count in part. Here a pixel counts from 128.

    {"question_id": 0, "image": "00.jpg", "text": "Please point out the free space between ... Your answer should ..."}

**RefSpatial-Bench** (277 questions in three splits by its paper; see its page for the licence). Where to get it:
`BAAI/RefSpatial-Bench` on Hugging Face, the Parquet files of `location`, `placement` and `unseen`. Official rule:
share of points inside the mask. `object` names the answer and stays hidden; `prompt` is asked, `suffix` (the answer's
format) is left out.

    id 0 | image | mask | object "the orange box" | prompt "Please point out the orange box." | suffix "..." | step 1

**RoboAfford-Eval** (338 questions by its paper; see its page for the licence). Where to get it:
`tyb197/RoboAfford` on GitHub or `Zray26/roboafford-eval` on Hugging Face: `annotations_normxy.json` or
`annotations_absxy.json`, `images/`, `masks/`. Official scorer: the repository @ae453cd, `evaluation.py`: the share of
points inside the mask (above half), 0 without a point. The same questions, with the answer's format cut off.

    {"category": "object affordance", "question": "What part of a mug should be gripped to lift it? Your answer ...",
     "answer": [[[269.7, 272.0], ...]], "img": "00.jpg", "mask": "object_affordance_img_00_anno_1.png"}

**VABench-P** (300 questions; see its page for the licence). Where to get it: `IffYuan/VABench-P` on Hugging Face, the
Parquet file of the split `test`, with the columns `id`, `problem`, `image`, `mask`. Rule of its authors' paper:
share of points inside the mask.

**Part-Affordance-2K** (2000 questions about where to grasp; see its page for the licence). Where to get it:
`IffYuan/Part-Affordance-2K` on Hugging Face: `data/train-*.parquet`, its only split, with the columns `question_id`,
`problem`, `image`, `mask` and `category_type`. Official scorer: pickxiguapi/Embodied-R1 @16c4534,
`eval/hf_inference_affordance.py`: the share of points on mask pixels above 0, averaged over samples, 0 without a point.
Here a pixel counts from 128, as in X-Square's scorer of the same data.

**PIO**, Point-It-Out (about 500 questions in the stages S1, which thing, and S2, where to act; see its page for the
licence). Where to get it: xavihart/PIO on GitHub: `s1s2.json` and `images_s1s2/` in its folder `data`. Official scorer:
the repository @569adf6, `code/utils/task.py`: the share of points inside the polygons; for boxes, `code/eval_s1s2.py`,
IoU with the polygon's box, which is not computed here. The third stage, S3, asks for a trace and is judged by a model.

    {"polygon": [[x1, y1, ..., xn, yn]], "image_path": ..., "height": ..., "width": ..., "lang": the question,
     "s1_or_s2": "s1" or "s2", "subclasses": "recommendation", ...}
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from a4agent.benchmarks import files
from a4agent.benchmarks.base import Benchmark, Sample, Truth
from a4agent.errors import DataError, require
from a4agent.imaging.load import load_image
from a4agent.types import Query

FORMAT = "Your answer should be formatted"
"""What follows in a question is the format of a text answer, which does not apply to an agent."""
HALF = 128


def create_where2place(path: str | Path) -> Benchmark:
    """Where2Place: free space (100 questions).

    Raises:
        DataError: it is not at `path`, or a row has no question.
    """
    root = files.folder(path, "where2place")
    index = root / "point_questions.jsonl"
    rows = [row for _, row in files.read_jsonl(index)]
    questions = [_question(row.get("text"), f"line {number} of {str(index)!r}") for number, row in enumerate(rows, 1)]
    pictures = [f"images/{row.get('image', '')}" for row in rows]
    masks = [f"masks/{number:02d}.jpg" for number in range(len(rows))]

    def sample(i: int) -> Sample:
        image = files.confined(root, pictures[i])
        truth = Truth(partial(_mask_in, root, masks[i]), category="placement", tags={"kind": "placement"})
        return Sample(Query(f"{i:03d}", image, questions[i]), truth)

    digest = files.digest([index.read_bytes(), *(files.sized(root, name) for name in (*pictures, *masks))])
    source = "data set wentao-yuan/where2place on Hugging Face"
    return Benchmark("where2place", "see its page", source, root, len(rows), sample, digest, expected=100)


def create_roboafford(path: str | Path) -> Benchmark:
    """RoboAfford-Eval: object affordances, object references and free space.

    Raises:
        DataError: it is not at `path`, or a row is not as in the published file.
    """
    root = files.folder(path, "roboafford-eval")
    names = ("annotations_normxy.json", "annotations_absxy.json", "annotations.json")
    index = next((root / name for name in names if (root / name).is_file()), None)
    if index is None:
        raise DataError(f"roboafford-eval needs {names[0]!r} in {str(root)!r}; get it from tyb197/RoboAfford on GitHub")
    rows = files.read_json(index)
    if not isinstance(rows, list):
        raise DataError(f"{str(index)!r} must hold a list of questions")
    rows = cast("list[Any]", rows)
    parsed: list[tuple[str, str, str, str]] = []
    for number, row in enumerate(rows):
        where = f"row {number} of {str(index)!r}"
        try:
            texts = [row["question"], row["img"], row["mask"], row.get("category", "")]
        except (KeyError, TypeError, AttributeError) as error:
            raise DataError(f"{where} is not a question: {error!r:.100}") from error
        if not all(isinstance(text, str) for text in texts):
            raise DataError(f"{where}: question, img, mask and category must be texts")
        question, image, mask, category = texts
        parsed.append((_question(question, where), f"images/{image}", f"masks/{mask}", category))

    def sample(i: int) -> Sample:
        question, image, mask, category = parsed[i]
        kind = "placement" if "spatial" in category or "place" in category else "part"
        truth = Truth(partial(_mask_in, root, mask), category=category, tags={"kind": kind})
        return Sample(Query(files.row_id(i, image), files.confined(root, image), question), truth)

    named = [name for _, image, mask, _ in parsed for name in (image, mask)]
    digest = files.digest([index.read_bytes(), *(files.sized(root, name) for name in named)])
    source = "tyb197/RoboAfford on GitHub"
    return Benchmark("roboafford-eval", "see its page", source, root, len(parsed), sample, digest, expected=338)


def create_refspatial(path: str | Path) -> Benchmark:
    """RefSpatial-Bench: location, placement and unseen; needs the extra `bench`.

    Raises:
        DataError: it is not at `path`, or has other columns.
        MissingExtraError: pyarrow is not installed.
    """
    splits = ("location", "placement", "unseen")
    source = "data set BAAI/RefSpatial-Bench on Hugging Face"
    return _from_parquet("refspatial-bench", path, splits, ("prompt", "object"), source, 277)


def create_vabench(path: str | Path) -> Benchmark:
    """VABench-P: points to act on (300 questions); needs the extra `bench`.

    Raises:
        DataError: it is not at `path`, or has other columns.
        MissingExtraError: pyarrow is not installed.
    """
    source = "data set IffYuan/VABench-P on Hugging Face"
    return _from_parquet("vabench-p", path, ("test",), ("problem", ""), source, 300)


def create_part_affordance(path: str | Path) -> Benchmark:
    """Part-Affordance-2K: where to grasp (2000 questions); needs the extra `bench`.

    Raises:
        DataError: it is not at `path`, or has other columns.
        MissingExtraError: pyarrow is not installed.
    """
    source = "data set IffYuan/Part-Affordance-2K on Hugging Face"
    return _from_parquet("part-affordance-2k", path, ("train",), ("problem", ""), source, 2000, "category_type")


def create_pio(path: str | Path) -> Benchmark:
    """PIO, stages S1 and S2: which thing, and where to act.

    Raises:
        DataError: it is not at `path`, or a row is not as in the published file.
    """
    root = files.folder(path, "pio")
    index = root / "s1s2.json"
    rows = files.read_json(index)
    if not isinstance(rows, list):
        raise DataError(f"{str(index)!r} must hold a list of questions")
    pictures: list[str] = []
    for number, row in enumerate(cast("list[Any]", rows)):
        texts = {key: row.get(key) for key in ("image_path", "lang", "s1_or_s2")} if isinstance(row, dict) else {}
        if not texts or not all(isinstance(text, str) and text for text in texts.values()):
            raise DataError(f"row {number} of {str(index)!r}: image_path, lang and s1_or_s2 must be texts")
        pictures.append(f"images_s1s2/{texts['image_path']}")

    def sample(i: int) -> Sample:
        row, where = cast("dict[str, Any]", rows[i]), f"row {i} of {str(index)!r}"
        size_hw = (row.get("height"), row.get("width"))
        truth = Truth(
            partial(files.read_polygons, row.get("polygon"), size_hw, where),
            category=str(row.get("subclasses") or ""),
            tags={"kind": "part", "stage": row["s1_or_s2"]},
        )
        return Sample(Query(f"{row['s1_or_s2']}-{i:04d}", files.confined(root, pictures[i]), row["lang"]), truth)

    digest = files.digest([index.read_bytes(), *(files.sized(root, name) for name in pictures)])
    return Benchmark("pio", "see its page", "xavihart/PIO on GitHub", root, len(pictures), sample, digest)


def _from_parquet(
    name: str,
    path: str | Path,
    splits: Sequence[str],
    columns: tuple[str, str],
    source: str,
    expected: int,
    category_column: str = "",
) -> Benchmark:
    """A data set of Parquet files, one or more a split, with pictures and masks inside."""
    parquet: Any = require("pyarrow.parquet", extra="bench")
    root = files.folder(path, name)
    question_column, object_column = columns
    tables: list[tuple[str, Any]] = []
    shards: list[Path] = []
    for split in splits:
        for shard in sorted(root.rglob(f"{split}-*.parquet")):
            shards.append(shard)
            try:
                tables.append((split, parquet.read_table(shard, memory_map=True)))
            except Exception as error:  # pyarrow raises errors of many kinds for a damaged file
                raise DataError(f"{str(shard)!r} is not a readable Parquet file: {error!r:.200}") from error
    if not tables:
        raise DataError(f"no file {splits[0]}-*.parquet below {str(root)!r}. Where to get it: {source}")
    for split, table in tables:
        missing = {question_column, "image", "mask"} - set(table.column_names)
        if missing:
            raise DataError(
                f"split {split!r} of {name} has no column {sorted(missing)[0]!r}, only {table.column_names}"
            )
    places = [(k, row) for k, (_, table) in enumerate(tables) for row in range(table.num_rows)]

    def sample(i: int) -> Sample:
        k, number = places[i]
        split, table = tables[k]
        where = f"row {number} of {split} in {name}"
        row = table.slice(number, 1).drop_columns(["mask"]).to_pylist()[0]
        truth = Truth(
            partial(_mask_of_row, table, number, where),
            object_name=str(row.get(object_column) or ""),
            category=str(row.get(category_column) or split),
            tags={"kind": "placement" if split == "placement" else "part", "step": str(row.get("step", ""))},
        )
        question = _question(row[question_column], where)
        return Sample(Query(f"{split}-{number:04d}", _bytes(row["image"], where), question), truth)

    digest = files.digest(files.sized(root, shard.relative_to(root).as_posix()) for shard in shards)
    return Benchmark(name, "see its page", source, root, len(places), sample, digest, expected=expected)


def _question(text: Any, where: str) -> str:
    """The question without the format of its answer."""
    if not isinstance(text, str) or not text.partition(FORMAT)[0].strip():
        raise DataError(f"{where} has no question, only {text!r:.80}")
    return text.partition(FORMAT)[0].strip()


def _bytes(stored: Any, where: str) -> bytes:
    data = stored.get("bytes") if isinstance(stored, dict) else None
    if not isinstance(data, bytes):
        raise DataError(f"{where} has no picture")
    return data


def _mask_of_row(table: Any, number: int, where: str) -> np.ndarray:
    stored = table.slice(number, 1).column("mask").to_pylist()[0]
    return _above_half(_bytes(stored, where))


def _mask_in(root: Path, relative: str) -> np.ndarray:
    return _above_half(files.confined(root, relative))


def _above_half(source: bytes | Path) -> np.ndarray:
    """A grey mask, perhaps blurred by JPEG, as (H, W) bool."""
    try:
        return np.asarray(load_image(source).convert("L")) >= HALF
    except Exception as error:
        raise DataError(f"cannot read the mask: {error}") from error
