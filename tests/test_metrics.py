"""The scores agree with what the peers' code prints, and each protocol treats the odd samples as it says."""

from __future__ import annotations

import json
import math
import random
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from a4agent.errors import DataError, UnknownNameError
from a4agent.metrics import (
    MEASURES,
    PROTOCOLS,
    Row,
    compare,
    contact_hit,
    intersection_union,
    iou,
    measure,
    measure_best,
    nearest_neighbour,
    score,
    score_by,
)

CASES = json.loads((Path(__file__).parent / "vectors" / "metrics.json").read_text())["cases"]
PRESETS = {"affordance-r1": "affordance_r1_reasonaff", "affordance-r1-umd": "affordance_r1_umd", "ragnet": "ragnet"}
NAMES = {"gIoU": "giou", "cIoU": "ciou", "P50": "p50", "P50_95": "p50_95"}

pairs = st.tuples(st.integers(0, 5000), st.integers(0, 5000)).map(lambda pair: (min(pair), max(pair)))


@pytest.mark.parametrize("protocol", PRESETS)
@pytest.mark.parametrize("case", range(len(CASES)))
def test_each_preset_prints_what_the_published_code_prints(case: int, protocol: str) -> None:
    scores = score(CASES[case]["intersection_union"], protocol, resamples=0)

    for name, value in CASES[case][PRESETS[protocol]].items():
        assert getattr(scores, NAMES[name]) == pytest.approx(value, abs=1e-15), name


def test_strict_is_the_umd_preset_where_nothing_failed() -> None:
    for case in CASES:
        strict, preset = (score(case["intersection_union"], name) for name in ("strict", "affordance-r1-umd"))
        assert {name: getattr(strict, name) for name in MEASURES} == {name: getattr(preset, name) for name in MEASURES}


def test_a_tie_is_below_its_threshold_at_every_threshold() -> None:
    for threshold in range(50, 100, 5):
        on = score([(threshold, 100)], resamples=0).p50_95
        above = score([(threshold * 10**9 + 1, 100 * 10**9)], resamples=0).p50_95
        assert round(10 * on) == (threshold - 50) / 5
        assert round(10 * above) == (threshold - 50) / 5 + 1


@pytest.mark.parametrize(
    ("protocol", "both_empty", "invalid", "error"),
    [("strict", 1.0, 0.0, 0.0), ("affordance-r1", None, 0.0, None), ("affordance-r1-umd", 1.0, 0.0, 0.0)],
)
def test_odd_samples(protocol: str, both_empty: float | None, invalid: float | None, error: float | None) -> None:
    assert iou(Row(0, 0), protocol) == both_empty
    assert iou(Row(0, 70, "invalid"), protocol) == invalid
    assert iou(Row(0, 70, "error"), protocol) == error
    assert iou(Row(0, 70), protocol) == 0.0  # an empty truth with a prediction
    assert iou(Row(0, 70, "empty"), protocol) == 0.0


def test_a_failed_sample_is_0_even_where_there_was_nothing_to_find() -> None:
    failed = measure(None, np.zeros((4, 4), bool))

    assert failed == Row(0, 0, "error", 0, None)
    assert iou(failed) == 0.0
    assert score([failed]).p50 == 0.0


def test_ragnet_adds_its_small_terms_and_has_no_thresholds() -> None:
    scores = score([(50, 100), (0, 0)], "ragnet")

    assert scores.giou == (50 / (100 + 1e-5) + 1) / 2
    assert scores.ciou == 50 / (100 + 1e-10)
    assert math.isnan(scores.p50)
    assert math.isnan(scores.p50_95)
    assert scores.to_dict()["p50"] is None
    assert json.loads(json.dumps(scores.to_dict(), allow_nan=False))["intervals"]["p50"] == [None, None]


def test_counts() -> None:
    rows = [
        Row(5, 10, truth_pixels=8, prediction_pixels=7),
        Row(0, 9, truth_pixels=0, prediction_pixels=9, resized=True),
        Row(0, 9, "empty", truth_pixels=9, prediction_pixels=0),
        Row(0, 9, "invalid", truth_pixels=9),
        Row(0, 9, "error", truth_pixels=9),
        Row(0, 0, truth_pixels=0, prediction_pixels=0),
    ]

    strict, dropping = score(rows), score(rows, "affordance-r1")

    assert (strict.n, strict.n_scored, strict.n_failed, strict.n_resized) == (6, 6, 2, 1)
    assert (strict.n_empty_truth, strict.n_empty_prediction) == (2, 2)
    assert (dropping.n, dropping.n_scored, dropping.n_failed) == (6, 4, 2)
    assert strict.giou == (0.5 + 1) / 6
    assert strict.ciou == 5 / (10 + 9 * 4)
    assert dropping.giou == 0.5 / 4


def test_a_mean_of_nothing_is_nan() -> None:
    for scores in (score([]), score([Row(0, 0)], "affordance-r1"), score([Row(0, 5, "error")], "affordance-r1")):
        assert all(math.isnan(getattr(scores, name)) for name in MEASURES)
        assert scores.n_scored == 0
        json.dumps(scores.to_dict(), allow_nan=False)
    assert math.isnan(score([(0, 0)]).ciou)


@pytest.mark.parametrize("row", [(5, 4), (-1, 4), (-3, -2)])
def test_impossible_counts_are_refused(row: tuple[int, int]) -> None:
    with pytest.raises(DataError, match="row 1"):
        score([(1, 2), row])


def test_an_unknown_protocol_suggests_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="'affordance-r1'"):
        score([], "affordance-r")


@given(st.lists(pairs, min_size=1, max_size=40), st.randoms(use_true_random=False), st.sampled_from(sorted(PROTOCOLS)))
@settings(max_examples=50, deadline=None)
def test_the_order_of_samples_changes_nothing_to_the_last_bit(
    rows: list[tuple[int, int]], shuffler: random.Random, protocol: str
) -> None:
    mixed = list(rows)
    shuffler.shuffle(mixed)

    assert str(score(rows, protocol, resamples=20)) == str(score(mixed, protocol, resamples=20))


@given(st.lists(pairs, min_size=1, max_size=30))
@settings(max_examples=50, deadline=None)
def test_scores_are_ordered_and_inside_their_bounds(rows: list[tuple[int, int]]) -> None:
    scores = score(rows, resamples=50)

    assert 0 <= scores.p50_95 <= scores.p50 <= 1
    assert 0 <= scores.giou <= 1
    for name, (low, high) in scores.intervals.items():
        if not math.isnan(low):
            assert 0 <= low <= high <= 1, name


def test_the_interval_covers_the_true_mean_about_as_often_as_it_says() -> None:
    generator = np.random.default_rng(7)
    covered = 0
    for _ in range(120):
        rows = [(int(value), 1000) for value in generator.integers(0, 1001, 60)]
        low, high = score(rows, resamples=200).intervals["giou"]
        covered += low <= 0.5 <= high

    assert 105 <= covered <= 120


def test_intervals_repeat_for_a_seed_and_narrow_with_n() -> None:
    rows = [(number % 101, 100) for number in range(100)]

    assert score(rows, seed=3).intervals == score(rows, seed=3).intervals
    assert score(rows, seed=3).intervals != score(rows, seed=4).intervals
    few, many = (score(rows * times).intervals["giou"] for times in (1, 16))
    assert (few[1] - few[0]) / (many[1] - many[0]) == pytest.approx(4, rel=0.2)
    assert math.isnan(score(rows, resamples=0).intervals["giou"][0])


def test_groups() -> None:
    rows = [Row(1, 2), Row(3, 4), Row(0, 4, "error")]

    groups = score_by(rows, ["mug", "fork", "mug"])

    assert groups["mug"].giou == 0.25
    assert groups["mug"].n_failed == 1
    assert groups["fork"].giou == 0.75
    with pytest.raises(ValueError, match="zip"):
        score_by(rows, ["mug"])


def test_masks_of_one_size() -> None:
    prediction, truth = np.zeros((4, 5), bool), np.zeros((4, 5), bool)
    prediction[:2], truth[1:] = True, True

    assert intersection_union(prediction, truth) == (5, 20)
    assert intersection_union(prediction.astype(np.uint8) * 255, truth.astype(float)) == (5, 20)
    assert measure(prediction, truth) == Row(5, 20, "ok", 15, 10, False)
    assert measure(prediction, truth, "invalid") == Row(0, 15, "invalid", 15, None, False)
    with pytest.raises(DataError, match=r"\(H, W\)"):
        intersection_union(prediction[None], truth)


@given(arrays.arrays(bool, st.tuples(st.integers(1, 9), st.integers(1, 9))), st.integers(1, 5))
def test_a_prediction_of_a_multiple_of_the_size_scores_as_itself(mask: np.ndarray, times: int) -> None:
    larger = np.kron(mask, np.ones((times, times), bool))

    assert np.array_equal(nearest_neighbour(larger, mask.shape), mask)
    row = measure(larger, mask)
    assert (row.intersection, row.union) == (int(mask.sum()), int(mask.sum()))
    assert row.resized == (times > 1)


@given(st.integers(1, 40), st.integers(1, 40))
def test_nearest_neighbour_takes_the_value_under_the_centre_as_pillow_does(source: int, target: int) -> None:
    from PIL import Image

    values = np.arange(source, dtype=np.uint8)[None]
    expected = np.asarray(Image.fromarray(values).resize((target, 1), Image.Resampling.NEAREST))

    found = nearest_neighbour(values, (1, target))
    between = (2 * np.arange(target) + 1) * source % (2 * target) == 0  # a centre on an edge: Pillow's floats drift
    assert np.array_equal(found[0, ~between], expected[0, ~between])


def test_the_best_of_several_right_answers_counts() -> None:
    prediction = np.zeros((4, 4), bool)
    prediction[:, 0] = True
    left, right = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    left[:, 0], right[:, 3] = True, True

    assert measure(prediction, right, alternatives=(left,)) == Row(4, 4, "ok", None, 4, False)
    assert measure(prediction, left, alternatives=(right,))[:2] == (4, 4)
    assert measure(None, left, alternatives=(right,))[:3] == (0, 4, "error")


def test_a_prediction_without_pixels_is_blank() -> None:
    assert measure(np.zeros((0, 0), bool), np.ones((3, 3), bool)) == Row(0, 9, "ok", 9, 0, True)


def test_only_blank_predictions_are_counted_as_blank() -> None:
    rows = [Row(0, 9, truth_pixels=9, prediction_pixels=0), *[Row(4, 9, truth_pixels=9, prediction_pixels=4)] * 2]
    assert score(rows).n_empty_prediction == 1


def test_a_run_compared_with_itself_differs_by_nothing() -> None:
    run = {str(number): Row(*pair) for number, pair in enumerate(CASES[3]["intersection_union"])}

    found = compare(run, run)

    assert all((d.value, d.low, d.high, d.clear) == (0, 0, 0, False) for d in found.differences.values())
    assert found.gained == found.lost == ()
    assert found.first == score(run.values()) == found.second


def test_a_paired_difference_is_narrower_than_two_intervals() -> None:
    """Every sample is better by the same bit: paired, that is certain, though the samples vary widely."""
    first = {str(number): Row(number % 90, 100) for number in range(300)}
    second = {name: Row(row.intersection + 5, 100) for name, row in first.items()}

    difference = compare(first, second).differences["giou"]

    assert difference.value == pytest.approx(0.05)
    assert difference.high - difference.low < 1e-9
    assert difference.clear
    low, high = score(first.values()).intervals["giou"]
    assert high - low > 0.05


def test_only_shared_samples_that_the_protocol_keeps_are_compared() -> None:
    first = {"a": Row(9, 10), "b": Row(1, 10), "c": Row(0, 10, "error"), "x": Row(1, 1)}
    second = {"b": Row(9, 10), "a": Row(1, 10), "c": Row(9, 10), "y": Row(0, 1), "z": Row(0, 1)}

    strict, dropping = compare(first, second), compare(first, second, "affordance-r1")

    assert (strict.n_shared, strict.n_only_first, strict.n_only_second) == (3, 1, 2)
    assert (strict.gained, strict.lost) == (("b", "c"), ("a",))
    assert strict.differences["giou"].value == pytest.approx((0.1 + 0.9 + 0.9) / 3 - 1.0 / 3)
    assert dropping.gained == ("b",)
    assert dropping.differences["giou"].value == pytest.approx(0)


def test_runs_that_cannot_be_compared() -> None:
    with pytest.raises(DataError, match="share no sample"):
        compare({"a": Row(1, 2)}, {"b": Row(1, 2)})
    with pytest.raises(DataError, match="'a' has 5 pixels"):
        compare({"a": Row(1, 9, truth_pixels=5)}, {"a": Row(1, 9, truth_pixels=6)})


def test_a_contact_is_the_deepest_point_and_must_lie_in_the_truth() -> None:
    ring = np.zeros((20, 20), bool)
    ring[2:18, 2:18] = True
    ring[5:17, 5:17] = False  # thick at the top and left
    truth = ring.copy()
    assert contact_hit(ring, (truth,)) == 1.0, "the middle of the ring would be a hole"
    assert contact_hit(ring, (~truth,)) == 0.0
    assert contact_hit(ring, (~truth, truth)) == 1.0, "one of several right masks is enough"
    assert contact_hit(np.zeros((20, 20), bool), (truth,)) == 0.0
    assert contact_hit(None, (truth,)) == 0.0
    assert contact_hit(ring, (np.zeros((20, 20), bool),)) is None
    assert contact_hit(ring.repeat(3, 0).repeat(2, 1), (truth,)) == 1.0, "in the truth's pixels"


@pytest.mark.parametrize("size", [479, 960, 1441])
def test_a_contact_of_a_large_mask_lies_in_it(size: int) -> None:
    for seed in range(20):
        mask = np.zeros((size, size + 37), bool)
        top, left, height, width = np.random.default_rng(seed).integers(1, size // 2, 4)
        mask[top : top + height, left : left + width] = True
        assert contact_hit(mask, (mask,)) == 1.0
    thin = np.zeros((1200, 1200), bool)
    thin[700, 3:1100] = True
    assert contact_hit(thin, (thin,)) == 1.0
    assert contact_hit(thin, (np.roll(thin, 1, 0),)) == 0.0


def test_the_best_mask_is_named() -> None:
    prediction = np.eye(4, dtype=bool)
    row, best = measure_best(prediction, (~prediction, prediction))
    assert (best, row[:2], row.truth_pixels) == (1, (4, 4), None)
    assert measure_best(prediction, (prediction,))[0].truth_pixels == 4
