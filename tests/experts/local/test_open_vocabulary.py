"""Which boxes are kept."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as stn

from a4agent.errors import ConfigError
from a4agent.experts.local.open_vocabulary import BoxSelection, best_boxes, centres, to_corners

BOXES = np.array([[0, 0, 10, 10], [1, 0, 11, 10], [50, 50, 60, 60], [0, 0, 10, 9]], float)
SCORES = np.array([0.5, 0.9, 0.3, 0.6])


def test_best_first_above_the_threshold():
    assert best_boxes(BOXES, SCORES, 0.0, 1.0, 10).tolist() == [1, 3, 0, 2]
    assert best_boxes(BOXES, SCORES, 0.5, 1.0, 10).tolist() == [1, 3]
    assert best_boxes(BOXES, SCORES, 0.0, 1.0, 1).tolist() == [1]
    assert best_boxes(BOXES[:0], SCORES[:0], 0.0, 0.5, 1).tolist() == []


def test_of_two_that_overlap_the_better_is_kept():
    assert best_boxes(BOXES, SCORES, 0.0, 0.5, 10).tolist() == [1, 2]
    assert best_boxes(BOXES, SCORES, 0.0, 0.85, 10).tolist() == [1, 3, 2]


corners = stn.arrays(float, st.tuples(st.integers(0, 8), st.just(4)), elements=st.floats(0, 100))


@given(corners, st.floats(0.05, 0.95), st.integers(0, 2**31))
def test_what_is_kept_overlaps_no_more_than_allowed_and_what_goes_overlaps_something_better(boxes, limit, seed):
    boxes = np.concatenate([np.minimum(boxes[:, :2], boxes[:, 2:]), np.maximum(boxes[:, :2], boxes[:, 2:]) + 1], 1)
    scores = np.random.default_rng(seed).uniform(0.1, 1, len(boxes))
    kept = best_boxes(boxes, scores, 0.0, limit, 100)

    def iou(a, b):
        sides = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
        overlap = max(sides[0], 0) * max(sides[1], 0)
        return overlap / ((a[2:] - a[:2]).prod() + (b[2:] - b[:2]).prod() - overlap)

    for i in kept:
        assert all(iou(boxes[i], boxes[j]) <= limit for j in kept if j != i)
    for i in set(range(len(boxes))) - set(kept.tolist()):
        assert any(iou(boxes[i], boxes[j]) > limit and scores[j] >= scores[i] for j in kept)


def test_corners_and_centres():
    assert to_corners(np.array([[0.5, 0.5, 0.2, 0.4]])).tolist() == [[0.4, 0.3, 0.6, 0.7]]
    assert centres(BOXES[:1]).tolist() == [[5, 5]]


@pytest.mark.parametrize("setting", [{"threshold": 1.0}, {"nms_iou": 0.0}, {"max_boxes": 0}, {"threshold": -0.1}])
def test_settings_have_bounds(setting):
    with pytest.raises(ConfigError):
        BoxSelection(**{"threshold": 0.3, "nms_iou": 0.5, "max_boxes": 5, **setting})
