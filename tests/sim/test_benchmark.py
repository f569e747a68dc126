"""Simulator sets read back: the public half, the truth, several right answers, and refusals."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from a4agent import metrics
from a4agent.benchmarks.registry import load
from a4agent.errors import DataError
from a4agent.sim import benchmark as sim

N = 3
EXAMPLES = Path(__file__).parents[2] / "examples" / "sim"


@pytest.fixture
def set_path(tmp_path: Path) -> Path:
    """Three samples as `a4agent.sim.make` writes them, without a renderer: squares for parts."""
    root = tmp_path / "set"
    lines: list[str] = []
    for folder in ("images", "masks", "regions", "objects", "depth"):
        (root / folder).mkdir(parents=True)
    for index in range(N):
        regions = np.zeros((40, 60), np.uint8)
        regions[5:15, 5:25] = 1
        regions[20:35, 30:40] = 2
        name = f"{index:04d}-cupboard"
        Image.fromarray(np.full((40, 60, 3), 50 * index, np.uint8)).save(root / f"images/{name}.jpg")
        Image.fromarray((regions > 0).astype(np.uint8) * 255).save(root / f"masks/{name}.png")
        Image.fromarray(regions).save(root / f"regions/{name}.png")
        Image.fromarray(np.full((40, 60), 255, np.uint8)).save(root / f"objects/{name}.png")
        Image.fromarray(np.full((40, 60), 1500, np.uint16)).save(root / f"depth/{name}.png")
        lines.append(json.dumps(_row(name, choose=("any", "all", "any")[index], numbers=[1] if index == 2 else [1, 2])))
    (root / "samples.jsonl").write_text("\n".join(lines) + "\n")
    (root / "set.json").write_text(json.dumps({"benchmark": "sim", "format": 1, "n": N, "seed": 4, "split": "dev"}))
    return root


def _row(name: str, choose: str, numbers: list[int]) -> dict[str, Any]:
    files = {"mask": "masks", "regions": "regions", "object_mask": "objects", "depth": "depth"}
    return {
        "image": f"images/{name}.jpg",
        **{key: f"{folder}/{name}.png" for key, folder in files.items()},
        "id": f"sim-4-{name}",
        "instruction": "Open one of the doors.",
        "object_name": "cupboard",
        "object_part": "the handles of the cupboard",
        "affordance": "pull",
        "direct": True,
        "choose": choose,
        "region_numbers": numbers,
        "visible_share": 0.8,
        "picture_share": 0.02,
        "depth_scale": 0.001,
        "camera_matrix": [[500, 0, 30], [0, 500, 20], [0, 0, 1]],
        "camera_pose": np.eye(4).tolist(),
    }


def test_an_agent_is_shown_a_picture_and_an_instruction_only(set_path: Path) -> None:
    benchmark = load("sim", set_path)
    assert len(benchmark) == N
    query = benchmark[0].query
    assert (query.id, query.instruction) == ("sim-4-0000-cupboard", "Open one of the doors.")
    assert query.image == (set_path / "images/0000-cupboard.jpg").resolve()
    assert set(vars(query)) == {"id", "image", "instruction"}


def test_the_truth_and_what_scores_are_broken_down_by(set_path: Path) -> None:
    truth = load("sim", set_path)[0].truth
    assert truth.mask().sum() == 200 + 150
    assert (truth.object_name, truth.object_part) == ("cupboard", "the handles of the cupboard")
    assert truth.tags == {
        "object": "cupboard",
        "affordance": "pull",
        "directness": "direct",
        "visible": "70 to 95 %",
        "size": "1 to 4 %",
    }


def test_any_of_several_parts_is_right_where_the_task_says_so(set_path: Path) -> None:
    any_of_them, all_of_them, only_one_seen = (sample.truth for sample in load("sim", set_path))
    first, second = any_of_them.alternatives()
    assert (first.sum(), second.sum()) == (200, 150)
    assert all_of_them.alternatives() == ()
    assert only_one_seen.alternatives() == ()

    def iou(mask: np.ndarray, truth: Any) -> float:
        row = metrics.measure(mask, truth.mask(), "ok", truth.alternatives())
        return row.intersection / row.union

    assert iou(first, any_of_them) == iou(second, any_of_them) == iou(first | second, any_of_them) == 1
    assert iou(first, all_of_them) == pytest.approx(200 / 350)
    assert iou(np.zeros((40, 60), bool), any_of_them) == 0


def test_the_folder_reader_reads_it_too(set_path: Path) -> None:
    as_folder, as_sim = load("folder", set_path), load("sim", set_path)
    for mine, theirs in zip(as_sim, as_folder, strict=True):
        assert mine.id == theirs.id
        assert (mine.truth.mask() == theirs.truth.mask()).all()
        assert mine.truth.object_part == theirs.truth.object_part


def test_depth_comes_in_metres_with_the_camera(set_path: Path) -> None:
    geometry = sim.read_geometry(set_path, sim.read_rows(set_path)[0])
    assert geometry.depth.dtype == np.float32
    assert np.allclose(geometry.depth, 1.5)
    assert geometry.matrix.shape == (3, 3)
    assert geometry.pose.shape == (4, 4)


def test_the_examples_are_a_set() -> None:
    benchmark = load("sim", EXAMPLES)
    assert [sample.truth.object_name for sample in benchmark] == ["microwave", "mug", "drawer", "hammer"]
    for row in sim.read_rows(EXAMPLES):
        (region,) = sim.read_regions(EXAMPLES, row)
        depth = sim.read_geometry(EXAMPLES, row).depth[region]
        assert 0.1 < depth.min() < depth.max() < 5


def test_another_set_has_another_fingerprint(set_path: Path) -> None:
    before = load("sim", set_path).fingerprint()
    assert before == load("sim", set_path).fingerprint()
    assert before["options"] == {"split": "dev", "seed": 4}
    text = (set_path / "samples.jsonl").read_text()
    (set_path / "samples.jsonl").write_text(text.replace("Open one", "Pull one", 1))
    assert load("sim", set_path).fingerprint()["sha256"] != before["sha256"]


@pytest.mark.parametrize(
    ("break_it", "says"),
    [
        (lambda root: (root / "set.json").unlink(), "no such file.*set.json"),
        (lambda root: (root / "set.json").write_text("[]"), "does not describe a sim set"),
        (lambda root: (root / "set.json").write_text('{"benchmark": "umd"}'), "does not describe a sim set"),
        (lambda root: _edit(root, "set.json", '"format": 1', '"format": 99'), "has format 99, this version reads 1"),
        (lambda root: _edit(root, "set.json", '"n": 3', '"n": 4'), "not finished: it has 3 of 4 samples"),
        (lambda root: _edit(root, "samples.jsonl", '"choose": "all"', '"choose": "both"'), "line 2 of .*choose"),
        (
            lambda root: _edit(root, "samples.jsonl", '"visible_share": 0.8', '"visible_share": 8'),
            "line 1 of .*visible",
        ),
        (lambda root: _edit(root, "samples.jsonl", "images/0000", "../../0000"), "not inside"),
        (lambda root: shutil.rmtree(root), "does not exist"),
    ],
)
def test_what_is_not_a_whole_set_is_refused(set_path: Path, break_it: Any, says: str) -> None:
    break_it(set_path)
    with pytest.raises(DataError, match=says):
        list(load("sim", set_path))


def test_a_lost_picture_is_named(set_path: Path) -> None:
    (set_path / "regions/0000-cupboard.png").unlink()
    with pytest.raises(DataError, match="0000-cupboard"):
        load("sim", set_path)[0].truth.alternatives()


def test_the_default_set_is_made_once(
    simulator: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("A4_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(sim, "DEFAULT_N", 2)
    first = sim.create()
    assert len(first) == 2
    assert "rendering a set of 2 samples once" in caplog.text
    assert first.root.is_relative_to(tmp_path)
    assert [path.name for path in first.root.parent.iterdir()] == [first.root.name]

    def never(*_: object, **__: object) -> Path:
        raise AssertionError("made twice")

    monkeypatch.setattr(sim, "make_set", never)
    assert sim.create().fingerprint() == first.fingerprint()


def test_a_default_set_that_was_broken_off_leaves_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def breaks_off(out: Path, **_: object) -> Path:
        out.mkdir()
        (out / "samples.jsonl").write_text("{")
        raise KeyboardInterrupt

    monkeypatch.setenv("A4_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(sim, "make_set", breaks_off)
    with pytest.raises(KeyboardInterrupt):
        sim.create()
    assert not [path for path in (tmp_path / "sim").rglob("*") if path.is_file()]


def _edit(root: Path, name: str, old: str, new: str) -> None:
    text = (root / name).read_text()
    assert old in text
    (root / name).write_text(text.replace(old, new, 1))
