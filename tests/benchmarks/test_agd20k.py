"""AGD20K: the published layout, and the published formula worked out by hand."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from a4agent.benchmarks.agd20k import SIDE, heatmap, heatmap_scores
from a4agent.benchmarks.registry import load
from a4agent.errors import ConfigError, DataError
from a4agent.types import Affordance, Region


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    for split, affordance, thing in (
        ("Seen", "cut_with", "knife"),
        ("Seen", "hold", "cup"),
        ("Unseen", "open", "oven"),
    ):
        for part, suffix in (("egocentric", "jpg"), ("GT", "png")):
            folder = tmp_path / split / "testset" / part / affordance / thing
            folder.mkdir(parents=True)
            picture = np.zeros((48, 64), np.uint8)
            picture[10:20, 10:30] = 200
            Image.fromarray(picture).save(folder / f"{thing}_000001.{suffix}")
    return tmp_path


def test_the_splits_are_read_apart(tree: Path) -> None:
    benchmark = load("agd20k", tree)
    assert [sample.id for sample in benchmark] == ["cut_with-knife-knife_000001", "hold-cup-cup_000001"]
    sample = benchmark[0]
    assert sample.query.instruction == "Where would you touch the knife to cut with it?"
    assert sample.truth.affordance == "cut with"
    assert sample.truth.mask().sum() == 200
    unseen = load("agd20k", tree, {"split": "unseen", "names": False})
    assert [sample.query.instruction for sample in unseen] == ["Where would you touch it to open it?"]
    assert unseen.digest != benchmark.digest


def test_a_wrong_split_or_folder_is_named(tree: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    with pytest.raises(ConfigError, match="'seen' or 'unseen', not 'test'"):
        load("agd20k", tree, {"split": "test"})
    with pytest.raises(DataError, match=r"AGD20K\.zip"):
        load("agd20k", tmp_path_factory.mktemp("empty"))


def test_the_formula_by_hand() -> None:
    """Two halves: the truth is on the left, the prediction has 3/4 of its mass there."""
    truth, prediction = np.zeros((SIDE, SIDE)), np.full((SIDE, SIDE), 50.0)
    truth[:, : SIDE // 2], prediction[:, : SIDE // 2] = 255.0, 150.0
    scores = heatmap_scores(prediction, truth)
    assert scores.kld == pytest.approx(math.log(1 / 0.75), abs=1e-6)
    assert scores.sim == pytest.approx(0.75, abs=1e-9)
    assert scores.nss == pytest.approx(1.0, abs=1e-9)


def test_a_perfect_map_and_a_blank_one() -> None:
    truth = np.random.default_rng(0).random((SIDE, SIDE)) * 255
    perfect = heatmap_scores(truth, truth)
    assert perfect.kld == pytest.approx(0.0, abs=1e-6)
    assert perfect.sim == pytest.approx(1.0)
    blank = heatmap_scores(np.zeros((SIDE, SIDE)), truth)
    assert blank.nss == 0.0
    assert blank.sim == pytest.approx(0.0, abs=1e-6)
    assert blank.kld > 10


def test_a_map_of_scored_masks() -> None:
    left, right = np.zeros((48, 64), bool), np.zeros((48, 64), bool)
    left[20:28, 8:24], right[20:28, 40:56] = True, True
    points = np.zeros((0, 2), np.float32)
    answer = Affordance("x", (64, 48), regions=(Region(None, points, left, 0.9), Region(None, points, right, 0.3)))
    heat = heatmap(answer)
    assert heat.shape == (48, 64)
    assert heat[24, 16] > 2 * heat[24, 48] > 0


def test_measures_come_with_the_benchmark(tree: Path) -> None:
    benchmark = load("agd20k", tree)
    sample = benchmark[0]
    region = Region(None, np.zeros((0, 2), np.float32), sample.truth.mask())
    assert benchmark.measure is not None
    good = benchmark.measure(sample, Affordance("x", (64, 48), regions=(region,)))
    none = benchmark.measure(sample, Affordance("x", (64, 48), status="empty"))
    assert good["sim"] > 0.5 > none["sim"]
    assert good["kld"] < none["kld"]
