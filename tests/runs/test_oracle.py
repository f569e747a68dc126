"""The truth in the place of a stage: what it gives, what it leaves to ask, and that the gains add up."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pictures
from a4agent.benchmarks import registry
from a4agent.benchmarks.base import Sample
from a4agent.errors import DataError, UnknownNameError
from a4agent.runs import scores
from a4agent.runs.bench import Bench
from a4agent.runs.compare import losses
from a4agent.runs.oracle import ORACLES, detection_of, given_of, oracle_of

MakeBench = Callable[..., Bench]


def test_boxes_are_tight_and_points_lie_deep_inside() -> None:
    mask = np.zeros((40, 60), dtype=bool)
    mask[10:20, 5:25] = True
    mask[25:38, 40:49] = True
    mask[0, 0] = True  # a speck
    found = detection_of(mask)
    assert found.boxes_xyxy.tolist() == [[5, 10, 25, 20], [40, 25, 49, 38]]
    for (x, y), box in zip(found.points_xy, found.boxes_xyxy, strict=True):
        assert box[0] + 4 <= x <= box[2] - 4
        assert box[1] + 4 <= y <= box[3] - 4


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 1), min_size=1, max_size=120), st.integers(1, 12))
def test_every_point_is_in_the_mask_and_every_box_has_it(bits: list[int], width: int) -> None:
    mask = np.array(bits[: len(bits) // width * width], dtype=bool).reshape(-1, width)
    found = detection_of(mask)
    assert len(found.boxes_xyxy) == len(found.points_xy)
    assert bool(len(found.boxes_xyxy)) == bool(mask.any())
    for (x, y), (x0, y0, x1, y1) in zip(found.points_xy, found.boxes_xyxy, strict=True):
        assert mask[int(y), int(x)]
        assert x0 <= x < x1
        assert y0 <= y < y1
        assert mask[int(y0) : int(y1), int(x0) : int(x1)].any()


def test_each_oracle_gives_its_stage_and_those_before(data: Path) -> None:
    sample = registry.load("folder", data)[3]
    thinker = given_of(sample, "thinker", sample.truth.mask())
    assert thinker.target is not None
    assert thinker.target.object_part == "the red part of the board"
    assert thinker.detection is None
    detector = given_of(sample, "detector", sample.truth.mask())
    assert detector.detection is not None
    assert detector.regions is None
    segmenter = given_of(sample, "segmenter", sample.truth.mask())
    assert segmenter.regions is not None
    assert np.array_equal(segmenter.regions[0].mask, sample.truth.mask())


def test_a_truth_of_another_size_is_brought_to_the_pictures(data: Path) -> None:
    sample = registry.load("folder", data)[3]
    small = Sample(sample.query, replace(sample.truth, load_mask=lambda: sample.truth.mask()[::2, ::2]))
    given = given_of(small, "segmenter", small.truth.mask())
    assert given.regions is not None
    assert given.regions[0].mask.shape == (pictures.HEIGHT, pictures.WIDTH)


def test_a_dataset_without_parts_cannot_replace_the_thinker(data: Path) -> None:
    sample = registry.load("folder", data)[3]
    unnamed = Sample(sample.query, replace(sample.truth, object_part=""))
    with pytest.raises(DataError, match="--oracle detector"):
        given_of(unnamed, "thinker", unnamed.truth.mask())
    assert given_of(unnamed, "detector", unnamed.truth.mask()).detection is not None


def test_an_unknown_oracle_suggests_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'segmenter'"):
        oracle_of("segmentor")


def test_stages_by_the_truth_are_not_asked_and_the_losses_add_up(bench: MakeBench) -> None:
    runs = [bench("none").run(pictures.agent())]
    asked: dict[str, set[str]] = {}
    for oracle in ORACLES:
        agent = pictures.agent()
        runs.append(bench(oracle, oracle=oracle).run(agent))
        asked[oracle] = {expert.id.partition(":")[2].partition("-")[0] for expert in agent.experts() if expert.requests}  # type: ignore[attr-defined]
    assert asked == {"thinker": {"detector", "segmenter"}, "detector": {"segmenter"}, "segmenter": set()}
    assert scores.score(runs[-1]).giou == 1.0, "the truth against itself, an empty one included"
    (table,) = losses([runs[2], runs[0], runs[3], runs[1]])
    assert [line.stage for line in table] == ["the run as it is", *ORACLES]
    total = sum(line.cost.value for line in table if line.cost)
    assert total == pytest.approx(1.0 - scores.score(runs[0]).giou)
    by_stage = {line.stage: line.cost.value for line in table if line.cost}
    assert by_stage["segmenter"] == pytest.approx(0.0), "filled boxes are the truth here"
    assert by_stage["thinker"] > 0, "two answers could not be read"
    assert by_stage["detector"] > 0.2


def test_a_broken_picture_fails_alone_in_an_oracle_run(bench: MakeBench, tmp_path: Path) -> None:
    folder = pictures.write_folder(tmp_path / "broken", 5, first=3)
    (folder / "4.png").write_bytes(b"not a picture")
    run = bench(benchmark=registry.load("folder", folder), oracle="detector").run(pictures.agent())
    assert {id: record.status for id, record in run.records.items() if record.status == "error"} == {
        "picture 4": "error"
    }
    assert len(run.records) == 5
