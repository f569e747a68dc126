"""Files of a dataset are untrusted: nothing outside its folder is read, and damage is an error that names the file."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from a4agent.benchmarks import files
from a4agent.errors import DataError
from layouts import boxed


@pytest.mark.parametrize(
    "name", ["../outside.png", "a/../../outside.png", "/etc/passwd", "", "a\x00b", "link.png", "dir/x"]
)
def test_a_path_cannot_leave_the_dataset(tmp_path: Path, name: str) -> None:
    root = tmp_path / "data"
    root.mkdir()
    (tmp_path / "outside.png").write_bytes(b"secret")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "x").write_bytes(b"secret")
    os.symlink(tmp_path / "outside.png", root / "link.png")
    os.symlink(tmp_path / "elsewhere", root / "dir")

    with pytest.raises(DataError) as caught:
        files.confined(root, name)
    assert ("a link leads out" in str(caught.value)) == (name in ("link.png", "dir/x"))


@pytest.mark.parametrize("name", ["a/b.png", "a/../b.png", "..b/c..png", "./x"])
def test_a_path_inside_is_fine(tmp_path: Path, name: str) -> None:
    assert files.confined(tmp_path.resolve(), name).is_relative_to(tmp_path.resolve())


def test_a_link_within_the_dataset_is_followed(tmp_path: Path) -> None:
    (tmp_path / "real.png").write_bytes(b"x")
    os.symlink(tmp_path / "real.png", tmp_path / "link.png")

    assert files.confined(tmp_path.resolve(), "link.png") == (tmp_path / "real.png").resolve()


@given(st.text(st.characters(), max_size=30) | st.text(st.characters(categories=["Cs"]), min_size=1, max_size=3))
def test_any_name_is_inside_or_refused(tmp_path_factory: pytest.TempPathFactory, name: str) -> None:
    root = tmp_path_factory.getbasetemp().resolve()
    try:
        path = files.confined(root, name)
    except DataError:
        return
    assert path.is_relative_to(root)


@pytest.mark.parametrize("mode", ["1", "L", "P", "RGB", "RGBA", "LA", "I;16"])
def test_foreground_is_any_value_but_0_in_every_mode(tmp_path: Path, mode: str) -> None:
    truth = boxed((2, 1, 7, 6))
    if mode == "I;16":
        picture = Image.fromarray(truth.astype(np.uint16) * 300)
    elif mode == "P":
        picture = Image.fromarray(truth.astype(np.uint8), mode="L").convert("L")
        picture.putpalette([0, 0, 0, 0, 0, 0] * 128)  # both entries black: the index is what counts
    else:
        picture = Image.fromarray(truth.astype(np.uint8) * 255).convert(mode)
    picture.save(tmp_path / "mask.png")

    assert np.array_equal(files.read_mask(tmp_path / "mask.png"), truth)


def test_a_value_of_1_is_foreground(tmp_path: Path) -> None:
    Image.fromarray(boxed((0, 0, 3, 3)).astype(np.uint8)).save(tmp_path / "mask.png")

    assert files.read_mask(tmp_path / "mask.png").sum() == 9


@pytest.mark.parametrize("content", [b"", b"not a picture", b"\x89PNG\r\n\x1a\n" + b"\x00" * 40])
def test_a_damaged_mask_is_an_error_that_names_it(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "mask.png").write_bytes(content)

    with pytest.raises(DataError, match=r"mask\.png"):
        files.read_mask(tmp_path / "mask.png")


def test_a_mask_cut_short_is_an_error(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    Image.fromarray(generator.integers(0, 255, (200, 200), np.uint8)).save(tmp_path / "mask.png")
    content = (tmp_path / "mask.png").read_bytes()
    (tmp_path / "mask.png").write_bytes(content[: len(content) // 2])

    with pytest.raises(DataError):
        files.read_mask(tmp_path / "mask.png")


@pytest.mark.parametrize(
    "polygons",
    [[[0, 0, 4, 0]], [[0, 0, 4, 0, 4]], [["a", 0, 4, 0, 4, 4]], [[0, 0, float("nan"), 0, 4, 4]], 7, [[[0, 0], [1, 1]]]],
)
def test_invalid_polygons_are_refused(polygons: object) -> None:
    with pytest.raises(DataError, match="sample 'x'"):
        files.read_polygons(polygons, (8, 12), "sample 'x'")


@pytest.mark.parametrize("size_hw", [(0, 5), (10**6, 10**6), ("a", 1), None])
def test_polygons_of_an_impossible_size(size_hw: object) -> None:
    with pytest.raises(DataError):
        files.read_polygons([[0, 0, 4, 0, 4, 4]], size_hw, "here")


@pytest.mark.parametrize("far", [1e9, -1e308, 1e308, 2**31, -25.0, 37.0])
def test_a_corner_far_outside_is_refused_before_it_is_drawn(far: float) -> None:
    """pycocotools walks along each edge and crashes the process, or fills its memory, on a single such number."""
    for polygon in ([10, 1, 5, 1, 5, far], [far, 1, 5, 1, 5, 4]):
        with pytest.raises(DataError, match=r"sample 'x': .*far outside the image of 12 x 8"):
            files.read_polygons([polygon], (8, 12), "sample 'x'")


def test_a_corner_just_outside_is_clipped() -> None:
    mask = files.read_polygons([[-3, -3, 6, -3, 6, 4, -3, 4]], (8, 12), "x")
    assert mask[:4, :6].all()
    assert mask.sum() == 24


def test_too_many_corners(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "MAX_COORDINATES", 10)
    with pytest.raises(DataError, match="more than 10 coordinates"):
        files.read_polygons([[1, 1, 5, 1, 5, 4]] * 2, (8, 12), "x")


def test_no_polygons_are_a_blank_mask() -> None:
    assert files.read_polygons([], (8, 12), "here").shape == (8, 12)


@pytest.mark.parametrize("content", [b"{", b"\xff\xfe", b"[" * 100_000])
def test_invalid_json_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.json").write_bytes(content)

    with pytest.raises(DataError, match=r"x\.json"):
        files.read_json(tmp_path / "x.json")


@pytest.mark.parametrize("line", ["{", "[1]", "3", "null", "[" * 100_000])
def test_an_invalid_jsonl_line_is_named_by_number(tmp_path: Path, line: str) -> None:
    (tmp_path / "x.jsonl").write_text(f'{{"a": 1}}\n\n{line}\n')

    with pytest.raises(DataError, match="line 3"):
        list(files.read_jsonl(tmp_path / "x.jsonl"))


def test_a_digest_keeps_its_parts_apart() -> None:
    assert files.digest(["ab", "c"]) != files.digest(["a", "bc"])


@given(st.lists(st.text(max_size=20), min_size=2, max_size=8))
def test_row_ids_are_unique_whatever_the_names(names: list[str]) -> None:
    ids = [files.row_id(number, name) for number, name in enumerate(names)]

    assert len(set(ids)) == len(ids)
    assert all(identity.isascii() and "/" not in identity and identity != ".." for identity in ids)
