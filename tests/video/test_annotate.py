"""Labels of every frame: exported, resumable, and never mixed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from a4agent.config import EngineSettings
from a4agent.errors import DataError, InputError
from a4agent.interop.detections import to_coco
from a4agent.testing import scripted_agent
from a4agent.types import Affordance
from a4agent.video.annotate import annotate, export
from a4agent.video.frames import open_frames

SETTINGS = EngineSettings()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "frames").mkdir()
    for number in range(6):
        Image.new("RGB", (32, 24), (40 * number, 0, 0)).save(tmp_path / "frames" / f"{number}.png")
    return tmp_path


def label(folder: Path, instruction: str = "open it", **recipe: str) -> tuple[int, list[str]]:
    asked: list[str] = []
    with open_frames(folder / "frames") as frames:
        count = annotate(
            scripted_agent(), frames, instruction, folder / "out", settings=SETTINGS,
            recipe=recipe, on_frame=lambda answer: asked.append(answer.id),
        )  # fmt: skip
    return count, asked


def test_every_frame_is_exported(folder: Path) -> None:
    assert label(folder)[0] == 6
    coco = json.loads((folder / "out" / "coco.json").read_text())
    assert [image["id"] for image in coco["images"]] == list(range(6))
    assert len({annotation["id"] for annotation in coco["annotations"]}) == 6
    parquet = pytest.importorskip("pyarrow.parquet")
    rows = parquet.read_table(folder / "out" / "annotations.parquet").to_pylist()
    assert [row["frame_index"] for row in rows] == list(range(6))
    assert rows[3]["timestamp"] == pytest.approx(0.3)
    assert rows[0]["object_part"] == "the handle of the thing"
    first = Affordance.from_dict(json.loads((folder / "out" / "frames.jsonl").read_text().splitlines()[0]))
    assert to_coco(first)[0]["area"] == 16 * 12


def test_a_broken_off_run_goes_on(folder: Path) -> None:
    label(folder)
    journal = folder / "out" / "frames.jsonl"
    lines = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(b"".join(lines[:3]) + lines[3][:40])
    count, asked = label(folder)
    assert count == 6
    assert len(asked) == 3
    assert label(folder) == (6, [])


def test_another_job_is_refused(folder: Path) -> None:
    label(folder, source="a.mp4")
    with pytest.raises(InputError, match="instruction 'open it', not 'close it'"):
        label(folder, "close it", source="a.mp4")
    with pytest.raises(InputError, match=r"source 'a\.mp4', not 'b\.mp4'"):
        label(folder, source="b.mp4")


def test_a_damaged_line_is_named(folder: Path) -> None:
    label(folder)
    journal = folder / "out" / "frames.jsonl"
    journal.write_text("{}\n" + journal.read_text())
    with pytest.raises(DataError, match="line 1 of"):
        export(folder / "out", 10.0)
