"""A written set: the same for the same seed, whole, and true to what it says of itself."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from a4agent.errors import ConfigError, DataError, MissingExtraError
from a4agent.sim import make
from a4agent.sim.catalogue import Catalogue
from a4agent.sim.draw import LEAST_PIXELS, LEAST_VISIBLE
from a4agent.sim.make import make_set


def _pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.array(image)


def _files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_the_same_seed_gives_the_same_files_whatever_the_workers(catalogue: Catalogue, tmp_path: Path) -> None:
    one = make_set(tmp_path / "one", n=2, seed=9, split="dev", workers=1)
    two = make_set(tmp_path / "two", n=2, seed=9, split="dev", workers=2)
    other = make_set(tmp_path / "other", n=1, seed=10, split="dev")
    assert _files(one) == _files(two)
    assert len(_files(one)) == 2 * 5 + 2
    assert not {*_files(one).values()} & {*_files(other).values()}


def test_rows_and_pictures_agree(made: Path, rows: list[dict[str, Any]]) -> None:
    assert len(rows) == 24
    assert len({row["object_name"] for row in rows}) == 24
    for row in rows:
        width, height = row["size_wh"]
        assert _pixels(made / row["image"]).shape == (height, width, 3)
        mask, regions = _pixels(made / row["mask"]), _pixels(made / row["regions"])
        assert set(np.unique(mask)) == {0, 255}
        assert ((mask > 0) == (regions > 0)).all()
        assert set(np.unique(regions)) - {0} == set(row["region_numbers"])
        assert len(row["parts"]) == len(row["boxes_xyxy"]) == len(row["points_xy"]) == len(row["region_numbers"])
        for number, box, (x, y) in zip(row["region_numbers"], row["boxes_xyxy"], row["points_xy"], strict=True):
            ys, xs = np.nonzero(regions == number)
            assert box == [xs.min(), ys.min(), xs.max() + 1, ys.max() + 1]
            assert regions[int(y), int(x)] == number
        assert (_pixels(made / row["object_mask"])[mask > 0] == 255).all()
        depth = _pixels(made / row["depth"])
        assert depth.dtype == np.uint16
        assert (depth[mask > 0] > 0).all()


def test_no_hidden_part_is_asked_for(made: Path, rows: list[dict[str, Any]]) -> None:
    for row in rows:
        assert row["visible_share"] + row["occluded_share"] + row["cut_share"] == pytest.approx(1, abs=2e-4)
        assert row["visible_share"] >= LEAST_VISIBLE or (row["choose"] == "any" and len(row["parts"]) > 1)
        width, height = row["size_wh"]
        assert row["picture_share"] * width * height >= LEAST_PIXELS - 4


def test_pictures_are_lit_and_differ(made: Path, rows: list[dict[str, Any]]) -> None:
    means, spreads = zip(
        *((p.mean(), p.std()) for p in (_pixels(made / row["image"]) for row in rows)),
        strict=True,
    )
    assert min(means) > 25
    assert max(means) < 235
    assert min(spreads) > 10
    assert np.std(means) > 8
    assert len({tuple(row["size_wh"]) for row in rows}) > 2
    assert 1 <= sum(row["arm"] is not None for row in rows) <= 20
    assert sum(bool(row["props"]) for row in rows) >= 6


def test_no_thing_of_the_other_split_stands_around(rows: list[dict[str, Any]], catalogue: Catalogue) -> None:
    splits = {thing.name: thing.split for thing in catalogue.things}
    kinds = {thing.name: thing.kind for thing in catalogue.things}
    for row in rows:
        for prop in set(row["props"]) & set(splits):
            assert splits[prop] == row["split"]
            assert row["direct"]
            assert kinds[prop] != kinds[row["object_name"]]


def test_the_set_says_what_made_it(made: Path) -> None:
    about = json.loads((made / "set.json").read_text(encoding="utf-8"))
    assert (about["n"], about["seed"], about["split"]) == (24, 5, "all")
    assert set(about["versions"]) == {"mujoco", "metaworld", "gymnasium-robotics", "robosuite"}
    assert all("MIT" in licence for licence in about["licences"].values())


def test_a_folder_with_something_in_it_is_left_alone(catalogue: Catalogue, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ConfigError, match="holds something already"):
        make_set(tmp_path, n=1)
    assert _files(tmp_path) == {"notes.txt": b"mine"}
    with pytest.raises(ConfigError, match="at least one sample, not 0"):
        make_set(tmp_path / "new", n=0)
    assert not (tmp_path / "new").exists()


def test_a_set_that_was_broken_off_goes_on_after_its_last_whole_row(
    catalogue: Catalogue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = make_set(tmp_path / "whole", n=3, seed=9, split="dev")
    broken = Path(shutil.copytree(whole, tmp_path / "broken"))
    lines = (whole / "samples.jsonl").read_bytes().splitlines(keepends=True)
    (broken / "samples.jsonl").write_bytes(lines[0] + lines[1][:100])
    for picture in sorted((broken / "images").iterdir())[1:]:
        picture.write_bytes(b"half a picture")
    drawn: list[int] = []
    monkeypatch.setattr(make, "draw_sample", _noting(drawn, make.draw_sample))
    make_set(broken, n=3, seed=9, split="dev")
    assert drawn == [1, 2]
    assert _files(broken) == _files(whole)
    assert make_set(broken, n=3, seed=9, split="dev") == broken
    assert drawn == [1, 2]
    with pytest.raises(ConfigError, match="another set, with seed 9 where 8 is asked for"):
        make_set(broken, n=3, seed=8, split="dev")


def _noting(drawn: list[int], draw: Callable[[Catalogue, Any], Any]) -> Callable[[Catalogue, Any], Any]:
    def draw_and_note(catalogue: Catalogue, plan: Any) -> Any:
        drawn.append(plan.index)
        return draw(catalogue, plan)

    return draw_and_note


def test_a_set_killed_before_any_sample_is_begun_again(
    catalogue: Catalogue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def rows(jobs: list[Any], workers: int) -> Iterator[dict[str, Any]]:
        return ({"id": plan.stem} for _, plan, _ in jobs)

    monkeypatch.setattr(make, "_rows", rows)
    whole = make_set(tmp_path / "whole", n=2)
    draft = "." + 32 * "a" + ".tmp"
    for number, there in enumerate(([], [draft], ["set.json"], ["set.json", "images/"], ["set.json", "samples.jsonl"])):
        out = tmp_path / str(number)
        out.mkdir()
        for name in there:
            if name.endswith("/"):
                (out / name).mkdir()
            else:
                (out / name).write_bytes((whole / name).read_bytes() if name == "set.json" else b"")
        make_set(out, n=2)
        assert {**_files(out), draft: b""} == {**_files(whole), draft: b""}


def test_workers_end_with_a_killed_parent(catalogue: Catalogue, tmp_path: Path) -> None:
    out = tmp_path / "set"
    command = [sys.executable, "-m", "a4agent.cli.main", "data", "make", "sim", "--out", str(out), "--n", "40"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    try:
        for _ in range(600):
            if (out / "samples.jsonl").is_file() and (out / "samples.jsonl").stat().st_size:
                break
            time.sleep(0.1)
    finally:
        process.kill()
    process.communicate(timeout=30)  # whoever still lives holds the other end of the pipe
    begun = (out / "samples.jsonl").read_bytes()
    assert begun.endswith(b"\n")
    assert 1 <= begun.count(b"\n") < 40


def test_where_nothing_can_be_written_it_says_so(catalogue: Catalogue, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(DataError, match=r"cannot be written.*--out"):
        make_set(tmp_path / "file" / "set", n=1)


def test_missing_assets_are_reported_before_anything_else(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def missing(catalogue: Catalogue) -> dict[str, str]:
        raise MissingExtraError("pip install --no-deps metaworld")

    monkeypatch.setattr(make, "check_installed", missing)
    with pytest.raises(MissingExtraError, match="--no-deps"):
        make_set(tmp_path / "new", n=1)
    assert not (tmp_path / "new").exists()
