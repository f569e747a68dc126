"""ReasonAff as `save_to_disk` wrote it: pictures as bytes, masks as nested lists."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from a4agent.benchmarks.reasonaff import create
from a4agent.errors import DataError
from layouts import SECRET, boxed

datasets = pytest.importorskip("datasets")


def test_rows_become_samples(reasonaff_path: Path) -> None:
    first, second = create(reasonaff_path)

    assert (first.id, second.id) == ("00000-mug_1", "00001-mug_1")
    assert first.query.instruction == "Which part do I hold?"
    assert Image.open(io.BytesIO(first.query.image)).size == (12, 8)
    assert np.array_equal(first.truth.mask(), boxed((1, 2, 5, 6)))
    assert np.array_equal(second.truth.mask(), boxed((0, 0, 2, 2), (6, 4)))  # a mask of its own size
    assert first.truth.object_part == f"{SECRET} handle"


def test_a_score_can_name_revision_and_rows(reasonaff_path: Path) -> None:
    fingerprint = create(reasonaff_path).fingerprint()

    state = json.loads((reasonaff_path / "test" / "state.json").read_text())
    assert fingerprint["revision"] == state["_fingerprint"]
    assert fingerprint["rows"] == 2
    assert create(reasonaff_path).expected == 600


def test_a_file_that_others_leave_beside_changes_nothing(reasonaff_path: Path) -> None:
    before = create(reasonaff_path).fingerprint()
    (reasonaff_path / "test" / "cache-1f0c3a9e.arrow").write_bytes(b"of somebody's map()")
    assert create(reasonaff_path).fingerprint() == before


def test_the_split_itself_is_as_good(reasonaff_path: Path) -> None:
    assert [sample.id for sample in create(reasonaff_path / "test")] == ["00000-mug_1", "00001-mug_1"]


def test_many_shards_are_read_in_order(reasonaff_path: Path, tmp_path: Path) -> None:
    whole = datasets.concatenate_datasets([datasets.Dataset.load_from_disk(str(reasonaff_path / "test"))] * 3)
    datasets.DatasetDict({"test": whole}).save_to_disk(str(tmp_path / "many"), num_shards={"test": 3})

    many = create(tmp_path / "many")

    assert len(many) == 6
    assert np.array_equal(many[4].truth.mask(), boxed((1, 2, 5, 6)))
    assert many[5].query.instruction == "Where do I pour?"


def test_other_columns_are_an_error(tmp_path: Path) -> None:
    datasets.Dataset.from_dict({"problem": ["x"]}).save_to_disk(str(tmp_path / "other"))

    with pytest.raises(DataError, match="no column 'image'"):
        create(tmp_path / "other")


def test_a_ragged_mask_is_refused(tmp_path: Path) -> None:
    row = {"image": [{"bytes": b"x", "path": None}], "problem": ["x"], "mask": [[[True], [True, False]]]}
    datasets.Dataset.from_dict(row).save_to_disk(str(tmp_path / "odd"))

    with pytest.raises(DataError, match="row 0"):
        create(tmp_path / "odd")[0].truth.mask()


@pytest.mark.parametrize("name", ["../../secret.arrow", "/etc/passwd"])
def test_a_shard_elsewhere_is_refused(reasonaff_path: Path, name: str) -> None:
    (reasonaff_path.parent / "secret.arrow").write_bytes(
        (reasonaff_path / "test/data-00000-of-00001.arrow").read_bytes()
    )
    state = reasonaff_path / "test" / "state.json"
    state.write_text(json.dumps({**json.loads(state.read_text()), "_data_files": [{"filename": name}]}))

    with pytest.raises(DataError):
        create(reasonaff_path)


def test_a_picture_elsewhere_is_refused(tmp_path: Path) -> None:
    (tmp_path / "secret.png").write_bytes(b"x")
    row = {"image": [{"bytes": None, "path": str(tmp_path / "secret.png")}], "problem": ["x"], "mask": [[[True]]]}
    datasets.Dataset.from_dict(row).save_to_disk(str(tmp_path / "linked"))

    with pytest.raises(DataError, match="not inside"):
        create(tmp_path / "linked")[0]


def test_damage_is_an_error_that_says_where_to_get_it(reasonaff_path: Path) -> None:
    (reasonaff_path / "test" / "data-00000-of-00001.arrow").write_bytes(b"damaged")
    with pytest.raises(DataError, match="ReasonAff"):
        create(reasonaff_path)
    (reasonaff_path / "test" / "state.json").unlink()
    with pytest.raises(DataError, match="save_to_disk"):
        create(reasonaff_path)
