"""Point benchmarks in the published layouts, and what must not reach an agent."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from a4agent.benchmarks.registry import load
from a4agent.errors import DataError

FORMAT = " Your answer should be formatted as a list of tuples, i.e. [(x1, y1), ...]."


def picture(shade: int = 90, kind: str = "PNG") -> bytes:
    file = io.BytesIO()
    Image.new("RGB", (64, 48), (shade,) * 3).save(file, kind)
    return file.getvalue()


def mask(kind: str = "PNG") -> bytes:
    values = np.zeros((48, 64), np.uint8)
    values[16:32, 16:48] = 255
    file = io.BytesIO()
    Image.fromarray(values).save(file, kind)
    return file.getvalue()


@pytest.fixture
def where2place(tmp_path: Path) -> Path:
    (tmp_path / "images").mkdir()
    (tmp_path / "masks").mkdir()
    rows = []
    for number in range(3):
        (tmp_path / "images" / f"{number:02d}.jpg").write_bytes(picture(kind="JPEG"))
        (tmp_path / "masks" / f"{number:02d}.jpg").write_bytes(mask("JPEG"))
        text = f"Point out the free space beside cup {number}.{FORMAT}"
        rows.append({"question_id": number, "image": f"{number:02d}.jpg", "text": text})
    (tmp_path / "point_questions.jsonl").write_text("\n".join(json.dumps(row) for row in rows))
    return tmp_path


def test_where2place(where2place: Path) -> None:
    benchmark = load("where2place", where2place)
    assert len(benchmark) == 3
    sample = benchmark[2]
    assert sample.query.instruction == "Point out the free space beside cup 2."
    assert sample.truth.tags == {"kind": "placement"}
    assert abs(int(sample.truth.mask().sum()) - 16 * 32) < 64  # JPEG blurs the edges
    assert benchmark.expected == 100


def test_where2place_without_a_question(where2place: Path) -> None:
    (where2place / "point_questions.jsonl").write_text(json.dumps({"image": "00.jpg", "text": FORMAT}))
    with pytest.raises(DataError, match=r"line 1 of .* has no question"):
        load("where2place", where2place)


@pytest.fixture
def roboafford(tmp_path: Path) -> Path:
    (tmp_path / "images").mkdir()
    (tmp_path / "masks").mkdir()
    rows: list[dict[str, Any]] = []
    for number, category in enumerate(("object affordance", "spatial affordance")):
        (tmp_path / "images" / f"{number:02d}.jpg").write_bytes(picture(kind="JPEG"))
        (tmp_path / "masks" / f"{number}.png").write_bytes(mask())
        rows.append(
            {
                "category": category,
                "question": f"What part of a mug should be gripped?{FORMAT}",
                "answer": [[[20.0, 20.0]]],
                "img": f"{number:02d}.jpg",
                "mask": f"{number}.png",
            }
        )
    (tmp_path / "annotations_normxy.json").write_text(json.dumps(rows))
    return tmp_path


def test_roboafford(roboafford: Path) -> None:
    benchmark = load("roboafford-eval", roboafford)
    samples = list(benchmark)
    assert [sample.truth.tags["kind"] for sample in samples] == ["part", "placement"]
    assert samples[0].query.instruction == "What part of a mug should be gripped?"
    assert samples[0].truth.mask().sum() == 16 * 32


@pytest.mark.parametrize("row", [{"question": "x"}, 3, {"question": 1, "img": "a", "mask": "b"}, {"img": None}])
def test_roboafford_with_a_damaged_row(roboafford: Path, row: Any) -> None:
    (roboafford / "annotations_normxy.json").write_text(json.dumps([row]))
    with pytest.raises(DataError, match="row 0 of"):
        load("roboafford-eval", roboafford)


def write_table(path: Path, rows: list[dict[str, Any]]) -> None:
    arrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    path.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(arrow.Table.from_pylist(rows), path)


def stored(data: bytes) -> dict[str, Any]:
    return {"bytes": data, "path": None}


def test_refspatial(tmp_path: Path) -> None:
    for split in ("location", "placement", "unseen"):
        rows = [
            {
                "id": number,
                "image": stored(picture()),
                "mask": stored(mask()),
                "object": "the orange box",
                "prompt": f"Please point out box {number}.",
                "suffix": FORMAT,
                "step": 1,
            }
            for number in range(2)
        ]
        write_table(tmp_path / "data" / f"{split}-00000-of-00001.parquet", rows)
    benchmark = load("refspatial-bench", tmp_path)
    samples = list(benchmark)
    assert [sample.id for sample in samples][:3] == ["location-0000", "location-0001", "placement-0000"]
    assert samples[1].query.instruction == "Please point out box 1."
    assert samples[2].truth.tags == {"kind": "placement", "step": "1"}
    assert samples[0].truth.object_name == "the orange box"
    assert samples[0].truth.mask().sum() == 16 * 32


def test_vabench(tmp_path: Path) -> None:
    row = {"id": "a", "problem": "Put the pot on the stove.", "image": stored(picture()), "mask": stored(mask())}
    write_table(tmp_path / "data" / "test-00000-of-00001.parquet", [row])
    (sample,) = load("vabench-p", tmp_path)
    assert sample.query.instruction == "Put the pot on the stove."
    assert sample.truth.mask().any()


def test_part_affordance(tmp_path: Path) -> None:
    row: dict[str, Any] = {"question_id": 7, "problem": "Where do I grasp the hammer?", "category_type": "hammer"}
    row |= {"image": stored(picture()), "mask": stored(mask())}
    write_table(tmp_path / "data" / "train-00000-of-00001.parquet", [row])
    benchmark = load("part-affordance-2k", tmp_path)
    (sample,) = benchmark
    assert sample.query.instruction == "Where do I grasp the hammer?"
    assert sample.truth.category == "hammer"
    assert sample.truth.tags["kind"] == "part"
    assert sample.truth.mask().sum() == 16 * 32
    assert benchmark.expected == 2000


def pio_row(**changes: Any) -> dict[str, Any]:
    row = {"polygon": [[16, 16, 48, 16, 48, 32, 16, 32]], "image_path": "a.jpg", "height": 48, "width": 64}
    return {**row, "lang": "Where do I grasp it?", "s1_or_s2": "s2", "subclasses": "affordance", **changes}


def test_pio(tmp_path: Path) -> None:
    (tmp_path / "images_s1s2").mkdir()
    (tmp_path / "images_s1s2" / "a.jpg").write_bytes(picture(kind="JPEG"))
    (tmp_path / "s1s2.json").write_text(json.dumps([pio_row(), pio_row(s1_or_s2="s1", subclasses="location")]))
    first, second = load("pio", tmp_path)
    assert first.query.instruction == "Where do I grasp it?"
    assert (first.id, second.id) == ("s2-0000", "s1-0001")
    assert (first.truth.tags["stage"], second.truth.category) == ("s2", "location")
    assert abs(int(first.truth.mask().sum()) - 16 * 32) <= 16 + 32 + 1, "the outline may count"
    assert first.truth.mask()[24, 32]
    (tmp_path / "s1s2.json").write_text(json.dumps([pio_row(lang="")]))
    with pytest.raises(DataError, match=r"row 0 of .*lang"):
        load("pio", tmp_path)
    (tmp_path / "s1s2.json").write_text(json.dumps([pio_row(polygon=None)]))
    with pytest.raises(DataError, match="row 0 of"):
        load("pio", tmp_path)[0].truth.mask()
    (tmp_path / "s1s2.json").write_text("{}")
    with pytest.raises(DataError, match="list of questions"):
        load("pio", tmp_path)


def test_a_table_without_a_column_is_named(tmp_path: Path) -> None:
    write_table(tmp_path / "test-0.parquet", [{"id": "a", "problem": "x", "image": stored(picture())}])
    with pytest.raises(DataError, match="has no column 'mask'"):
        load("vabench-p", tmp_path)
    (tmp_path / "test-0.parquet").write_bytes(b"PAR1 broken")
    with pytest.raises(DataError, match="not a readable Parquet file"):
        load("vabench-p", tmp_path)
    with pytest.raises(DataError, match="no file location-"):
        load("refspatial-bench", tmp_path)
