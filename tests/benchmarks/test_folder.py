"""People's own pictures: samples.jsonl and COCO."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from a4agent.benchmarks.folder import create
from a4agent.errors import DataError
from a4agent.imaging.masks import encode_rle
from layouts import SECRET, boxed


def write(folder: Path, *rows: dict[str, Any]) -> Path:
    (folder / "samples.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def test_rows_become_samples(folder_path: Path) -> None:
    samples = list(create(folder_path))

    assert samples[0].query.instruction == "pick it up"
    assert samples[0].query.image == (folder_path / "a" / "mug.v1.jpg").resolve()
    assert np.array_equal(samples[1].truth.mask(), boxed((1, 1, 6, 5)))
    assert (samples[0].truth.object_name, samples[0].truth.affordance) == (SECRET, SECRET)
    assert samples[0].truth.category == SECRET


def test_pictures_of_the_same_name_have_different_ids(folder_path: Path) -> None:
    assert [sample.id for sample in create(folder_path)] == ["00000-mug.v1", "00001-mug.v1", "00002-mug.v2"]


def test_given_ids_are_kept_and_may_be_numbers(folder_path: Path) -> None:
    row = {"image": "a/mug.v1.jpg", "mask": "a/mug.v1_mask.png", "instruction": "x"}
    write(folder_path, {**row, "id": "my/own id"}, {**row, "id": 7})

    assert [sample.id for sample in create(folder_path)] == ["my/own id", "7"]


def test_an_id_used_twice_is_an_error_that_names_both_rows(folder_path: Path) -> None:
    row = {"image": "a/mug.v1.jpg", "mask": "a/mug.v1_mask.png", "instruction": "x"}
    write(folder_path, {**row, "id": "a"}, {**row, "id": "b"}, {**row, "id": "a"})

    with pytest.raises(DataError, match=r"samples 1 and 3 .* 'a'"):
        create(folder_path)


def test_masks_may_be_rle_or_many(folder_path: Path) -> None:
    first, second = encode_rle(boxed((0, 0, 2, 2))), encode_rle(boxed((5, 5, 9, 8)))
    row = {"image": "a/mug.v1.jpg", "instruction": "x"}
    write(folder_path, {**row, "mask": first}, {**row, "mask": [first, second, "a/mug.v1_mask.png"]})

    one, many = [sample.truth.mask() for sample in create(folder_path)]

    assert np.array_equal(one, boxed((0, 0, 2, 2)))
    assert np.array_equal(many, boxed((0, 0, 2, 2)) | boxed((5, 5, 9, 8)) | boxed((0, 1, 6, 5)))


@pytest.mark.parametrize(
    "row",
    [
        {"mask": "m.png", "instruction": "x"},
        {"image": "i.png", "mask": "m.png"},
        {"image": "i.png", "mask": "m.png", "instruction": "  "},
        {"image": 3, "mask": "m.png", "instruction": "x"},
        {"image": "i.png", "instruction": "x"},
        {"image": "i.png", "mask": 5, "instruction": "x"},
        {"id": [], "image": "i.png", "mask": "m.png", "instruction": "x"},
        {"id": "", "image": "i.png", "mask": "m.png", "instruction": "x"},
    ],
)
def test_a_row_that_lacks_something_is_named_by_its_line(tmp_path: Path, row: dict[str, Any]) -> None:
    with pytest.raises(DataError, match="line 1"):
        create(write(tmp_path, row))


@pytest.mark.parametrize("key", ["image", "mask"])
def test_a_row_cannot_name_a_file_elsewhere(folder_path: Path, key: str) -> None:
    (folder_path.parent / "outside.png").write_bytes(b"x")
    row = {"image": "a/mug.v1.jpg", "mask": "a/mug.v1_mask.png", "instruction": "x", key: "../outside.png"}
    benchmark = create(write(folder_path, row))

    with pytest.raises(DataError, match="not inside"):
        benchmark[0].truth.mask()


def test_masks_of_two_sizes_cannot_be_united(folder_path: Path) -> None:
    masks = [encode_rle(boxed((0, 0, 2, 2))), encode_rle(np.zeros((3, 3), bool))]
    write(folder_path, {"image": "a/mug.v1.jpg", "mask": masks, "instruction": "x"})

    with pytest.raises(DataError, match="two sizes"):
        create(folder_path)[0].truth.mask()


def test_annotations_of_one_caption_are_one_sample(coco_path: Path) -> None:
    lift, turn = create(coco_path)

    assert (lift.query.instruction, turn.query.instruction) == ("lift it", "turn it")
    assert lift.truth.mask()[:4, :4].all()
    assert lift.truth.mask()[:4, 8:].all()
    assert not lift.truth.mask()[:, 5:8].any()
    assert turn.truth.mask().all()
    assert lift.truth.category == SECRET


@pytest.mark.parametrize(
    "change",
    [
        {"annotations": [{"id": 9, "image_id": 4, "segmentation": []}]},
        {"annotations": [{"id": 9, "image_id": 5, "caption": "x", "segmentation": []}]},
        {"images": 3},
        {"images": [{"id": 4}]},
    ],
)
def test_an_invalid_coco_file_is_refused(coco_path: Path, change: dict[str, Any]) -> None:
    index = coco_path / "annotations.json"
    index.write_text(json.dumps({**json.loads(index.read_text()), **change}))

    with pytest.raises(DataError, match=r"annotations\.json"):
        create(coco_path)


def test_a_folder_without_an_index(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"samples\.jsonl"):
        create(tmp_path)
    with pytest.raises(DataError, match="does not exist"):
        create(tmp_path / "nowhere")
