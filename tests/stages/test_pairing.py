"""Boxes and points: cleaning and pairing."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from a4agent.stages.pairing import (
    Pairing,
    clean_boxes,
    clean_points,
    pair_as_paper,
    pair_by_holder,
    pair_optimally,
    to_prompts,
)
from a4agent.types import Detection

SIZE = (64, 48)
numbers = st.floats(-200, 200, width=32) | st.just(float("nan")) | st.just(float("inf"))


def some(columns: int, most: int = 6) -> st.SearchStrategy[np.ndarray]:
    return st.integers(0, most).flatmap(lambda rows: arrays(np.float32, (rows, columns), elements=numbers))


@given(some(4))
def test_clean_boxes_have_area_inside_the_image(boxes: np.ndarray) -> None:
    clean, kept = clean_boxes(boxes, SIZE)
    assert len(clean) == len(kept)
    assert (clean[:, 2:] > clean[:, :2]).all()
    assert (clean >= 0).all()
    assert (clean[:, [0, 2]] <= SIZE[0]).all()
    assert (clean[:, [1, 3]] <= SIZE[1]).all()
    again, _ = clean_boxes(clean, SIZE)
    np.testing.assert_array_equal(again, clean)


@given(some(2))
def test_clean_points_are_pixels_of_the_image(points: np.ndarray) -> None:
    clean, kept = clean_points(points, SIZE)
    assert len(clean) == len(kept)
    assert ((clean >= 0) & (clean.astype(int) < SIZE)).all()


def test_swapped_corners_are_put_in_order_and_outside_boxes_dropped() -> None:
    boxes = np.array([[30, 40, 10, 20], [70, 0, 90, 10], [-5, -5, 5, 5], [3, 3, 3, 9]])
    clean, kept = clean_boxes(boxes, SIZE)
    np.testing.assert_array_equal(clean, [[10, 20, 30, 40], [0, 0, 5, 5]])
    assert kept.tolist() == [0, 2]


def test_the_papers_rule_pairs_by_index_or_takes_points_alone() -> None:
    assert pair_as_paper(2, 2) == [(0, [0]), (1, [1])]
    assert pair_as_paper(1, 2) == [(None, [0]), (None, [1])]
    assert pair_as_paper(2, 0) == []
    assert pair_as_paper(0, 0) == []


def test_points_find_their_boxes_whatever_the_order() -> None:
    boxes = np.array([[0, 0, 10, 10], [20, 20, 30, 30]])
    points = np.array([[25, 25], [5, 5]])
    assert pair_optimally(boxes, points) == [(0, [1]), (1, [0])]


def test_boxes_without_points_stand_alone_and_so_do_points_outside_all_boxes() -> None:
    boxes = np.array([[0, 0, 10, 10], [20, 20, 30, 30]])
    points = np.array([[5, 5], [50, 40]])
    assert pair_optimally(boxes, points) == [(0, [0]), (1, []), (None, [1])]


def test_a_second_point_in_a_box_adds_no_region() -> None:
    assert pair_optimally(np.array([[0, 0, 10, 10]]), np.array([[9, 9], [5, 5]])) == [(0, [1])]


def test_one_kind_alone_and_neither() -> None:
    assert pair_optimally(np.zeros((0, 4)), np.array([[5, 5]])) == [(None, [0])]
    assert pair_optimally(np.array([[0, 0, 10, 10]]), np.zeros((0, 2))) == [(0, [])]
    assert pair_optimally(np.zeros((0, 4)), np.zeros((0, 2))) == []


@given(some(4, 4), some(2, 4))
def test_optimal_pairs_are_one_to_one_inside_and_as_many_as_can_be(boxes: np.ndarray, points: np.ndarray) -> None:
    boxes, points = clean_boxes(boxes, SIZE)[0], clean_points(points, SIZE)[0]
    pairs = pair_optimally(boxes, points)
    assert sorted(i for i, _ in pairs if i is not None) == list(range(len(boxes)))
    taken = [(i, j) for i, js in pairs for j in js if i is not None]
    assert len({j for _, j in taken}) == len(taken)
    assert all((boxes[i, :2] <= points[j]).all() and (points[j] <= boxes[i, 2:]).all() for i, j in taken)
    assert len(taken) == most_pairs(boxes, points)


def test_a_point_beside_a_tiny_box_is_not_inside_it() -> None:
    tiny = np.array([[1e-12, 1e-12, 1e-10, 1e-10]])
    assert pair_optimally(tiny, np.array([[0.0, 0.0]])) == [(0, []), (None, [0])]


def most_pairs(boxes: np.ndarray, points: np.ndarray) -> int:
    """By trying every assignment."""
    inside = [[bool((b[:2] <= p).all() and (p <= b[2:]).all()) for p in points] for b in boxes]
    if not inside or not len(points):
        return 0
    slots = [*range(len(points)), *[None] * len(boxes)]
    return max(
        sum(j is not None and inside[i][j] for i, j in enumerate(chosen))
        for chosen in itertools.permutations(slots, len(boxes))
    )


def prompts_of(boxes: object, points: object, pairing: Pairing, **more: Any) -> list[tuple[Any, list[Any], Any]]:
    """The prompts as lists: box, points, index of the box."""
    detection = Detection(
        np.array(boxes, np.float32).reshape(-1, 4), np.array(points, np.float32).reshape(-1, 2), **more
    )
    found = to_prompts(detection, SIZE, pairing)
    return [(p.box_xyxy if p.box_xyxy is None else p.box_xyxy.tolist(), p.points_xy.tolist(), i) for p, i in found]


def test_prompts_carry_the_paired_arrays() -> None:
    found = prompts_of([[0, 0, 10, 10]], [[5, 5], [50, 40]], "optimal")
    assert found == [([0, 0, 10, 10], [[5, 5]], 0), (None, [[50, 40]], None)]


def test_the_papers_rule_pairs_before_it_cleans() -> None:
    """Two boxes and two points, one box without area: its point stands alone, and the other pair stays a pair."""
    found = prompts_of([[5, 5, 5, 9], [20, 20, 30, 30]], [[5, 6], [25, 25]], "paper")
    assert found == [(None, [[5, 6]], None), ([20, 20, 30, 30], [[25, 25]], 1)]
    assert prompts_of([[20, 20, 30, 30]], [[99, 99]], "paper") == [([20, 20, 30, 30], [], 0)]
    assert prompts_of([[5, 5, 5, 9]], [[99, 99]], "paper") == []


@pytest.mark.parametrize("pairing", ["optimal", "paper", "inside"])
def test_derived_points_prompt_nothing(pairing: Pairing) -> None:
    found = prompts_of([[0, 0, 10, 10], [20, 20, 30, 30]], [[5, 5], [25, 25]], pairing, points_derived=True)
    assert found == [([0, 0, 10, 10], [], 0), ([20, 20, 30, 30], [], 1)]


def test_a_contested_point_outside_a_box_is_worth_less_than_any_pair() -> None:
    """Three points near the centre of one box, none in the other: the far point must not be given to it."""
    boxes = np.array([[0, 0, 10, 10], [4, 4, 14, 14]])
    points = np.array([[5, 5], [1, 1], [60, 40]])
    assert pair_optimally(boxes, points) == [(0, [1]), (1, [0]), (None, [2])]


def test_a_box_takes_all_the_points_it_holds() -> None:
    boxes = np.array([[0, 0, 10, 10], [4, 4, 30, 30]])
    points = np.array([[1, 1], [5, 5], [20, 20], [90, 90]])
    assert pair_by_holder(boxes, points) == [(0, [0, 1]), (1, [2]), (None, [3])]
    assert pair_by_holder(np.zeros((0, 4)), points[:1]) == [(None, [0])]
    assert pair_by_holder(boxes, np.zeros((0, 2))) == [(0, []), (1, [])]
    assert prompts_of(boxes, points, "inside")[0][1] == [[1, 1], [5, 5]]


def test_a_single_box_takes_the_points_outside_it_too() -> None:
    assert pair_by_holder(np.array([[0, 0, 10, 10]]), np.array([[5, 5], [30, 30]])) == [(0, [0, 1])]


def test_points_on_the_right_and_bottom_edges_are_moved_just_inside() -> None:
    points = np.array([[64, 48], [0, 0], [64.1, 5], [5, -0.1], [np.nan, 5]])
    clean, kept = clean_points(points, SIZE)
    assert kept.tolist() == [0, 1]
    assert clean.astype(int).tolist() == [[63, 47], [0, 0]]
