"""UMD's two rules agree with what the peers' code computes, and ask what they ask."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from a4agent.benchmarks import umd
from a4agent.errors import DataError, UnknownNameError
from layouts import boxed

VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "umd_ranks.json").read_text())


@pytest.mark.parametrize(("rule", "key"), [("a4", "rank_one"), ("affordance-r1", "affordance_r1")])
@pytest.mark.parametrize("case", range(len(VECTORS)))
def test_truth_agrees_with_the_published_code(case: int, rule: str, key: str) -> None:
    for affordance, expected in VECTORS[case][key].items():
        mask = umd.truth_mask(np.array(VECTORS[case]["gt_label"]), affordance, rule)

        assert mask.dtype == np.bool_
        assert np.array_equal(mask, np.array(expected, bool)), affordance


@given(arrays.arrays(np.uint8, (3, 4, 7), elements=st.integers(0, 9)))
def test_the_integers_are_the_published_formula(ranks: np.ndarray) -> None:
    highest = ranks.max()
    with np.errstate(invalid="ignore"):
        weight = np.where(ranks == 0, 0.0, 1 - ranks / max(int(highest), 1))
    expected = np.floor(255 * weight + 1e-9) / 255 > 0.5

    for number, affordance in enumerate(umd.AFFORDANCES):
        assert np.array_equal(umd.truth_mask(ranks, affordance, "affordance-r1"), expected[:, :, number])


def test_unknown_words_and_shapes() -> None:
    with pytest.raises(UnknownNameError, match="'grasp'"):
        umd.truth_mask(np.zeros((2, 2, 7)), "grsp", "a4")
    with pytest.raises(UnknownNameError, match="a4"):
        umd.truth_mask(np.zeros((2, 2, 7)), "grasp", "a5")
    with pytest.raises(DataError, match="7"):
        umd.truth_mask(np.zeros((2, 2, 6)), "grasp", "a4")


def test_the_a4_rule_counts_files(umd_path: Path) -> None:
    samples = list(umd.create(umd_path))

    assert [sample.id for sample in samples[:4]] == [
        "bowl_02_00000003-contain",
        "bowl_02_00000003-grasp",
        "bowl_02_00000033-contain",
        "bowl_02_00000033-grasp",
    ]
    assert samples[0].query.instruction == "Find the part of the object in the center of the image that can contain"
    assert not samples[0].truth.mask().any()  # its only rank is 2
    knife = {sample.id: sample for sample in samples}["knife_01_00000033-grasp"]
    assert np.array_equal(knife.truth.mask(), boxed((0, 0, 12, 4)))
    assert knife.truth.category == "knife"


def test_the_a4_rule_still_counts_files_when_numbers_have_gaps(umd_path: Path) -> None:
    for number in (1, 2):
        (umd_path / "tools" / "knife_01" / f"knife_01_{number:08d}_rgb.jpg").unlink()

    assert "knife_01_00000005-cut" in [sample.id for sample in umd.create(umd_path)]


def test_the_other_rule_reads_file_numbers_and_names_the_category(umd_path: Path) -> None:
    samples = list(umd.create(umd_path, rule="affordance-r1"))

    assert [sample.id for sample in samples[:2]] == ["bowl_02_00000001-contain", "bowl_02_00000001-grasp"]
    assert samples[0].query.instruction == "What part of the bowl should we interact with in order to contain it?"
    assert np.array_equal(samples[0].truth.mask(), boxed((0, 2, 12, 6)))  # floor(255 * (1 - 2 / 5)) = 153


def test_the_folder_of_tools_is_as_good(umd_path: Path) -> None:
    assert umd.create(umd_path / "tools").fingerprint() == umd.create(umd_path).fingerprint()


def test_tools_of_no_known_category_are_not_asked_about(umd_path: Path) -> None:
    assert not [sample for sample in umd.create(umd_path) if "lamp" in sample.id]


def test_all_seventeen_categories_are_asked_twice_a_frame(tmp_path: Path) -> None:
    names = [category for members in umd.CATEGORIES.values() for category in members]
    for name in names:
        (tmp_path / f"{name}_01").mkdir()
        for frame in range(1, 64):
            (tmp_path / f"{name}_01" / f"{name}_01_{frame:08d}_rgb.jpg").touch()

    assert len(set(names)) == 17
    assert len(umd.create(tmp_path)) == 17 * 2 * len(range(2, 63, 30))
    assert len(umd.create(tmp_path, rule="affordance-r1")) == 17 * 2 * len(range(1, 64, 30))


@pytest.mark.parametrize("content", [b"", b"MATLAB 5.0 MAT-file, damaged" + b"\x00" * 200])
def test_a_damaged_file_of_ranks(umd_path: Path, content: bytes) -> None:
    file = umd_path / "tools/bowl_02/bowl_02_00000003_label_rank.mat"
    file.write_bytes(content)

    with pytest.raises(DataError, match="label_rank"):
        umd.create(umd_path)[0].truth.mask()
    file.unlink()
    with pytest.raises(DataError, match="no such file"):
        umd.create(umd_path)[0].truth.mask()


def test_a_folder_that_is_not_umd(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"2\.99 GB"):
        umd.create(tmp_path)
