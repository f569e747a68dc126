"""Run-length encoding against COCO's own rules."""

from __future__ import annotations

import contextlib
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from a4agent.errors import DataError
from a4agent.imaging.masks import box_area, box_iou, box_overlap, decode_rle, deepest_point, encode_rle, iou, tight_box


@given(arrays(bool, array_shapes(min_dims=2, max_dims=2, max_side=20)))
def test_masks_round_trip(mask: np.ndarray) -> None:
    packed = json.loads(json.dumps(encode_rle(mask)))
    np.testing.assert_array_equal(decode_rle(packed), mask)


def test_counts_run_down_the_columns() -> None:
    mask = np.zeros((3, 2), bool)
    mask[1:, 0] = True
    np.testing.assert_array_equal(decode_rle({"size": [3, 2], "counts": [1, 2, 3]}), mask)


def test_no_pixels() -> None:
    assert decode_rle(encode_rle(np.zeros((0, 4), bool))).shape == (0, 4)


@pytest.mark.parametrize(
    "value",
    [
        {},
        {"size": [2, 2]},
        {"size": [2], "counts": ""},
        {"size": [-1, 4], "counts": ""},
        {"size": [2, 2], "counts": "é"},
        {"size": [2, 2], "counts": [9, 9, 9]},
        {"size": [2, 2], "counts": [3]},
        {"size": [2, 2], "counts": [5, -1]},
        {"size": [2, 2], "counts": [[1, 1], [1, 1]]},
        {"size": [2, 2], "counts": ""},
        {"size": [2, 2], "counts": "3"},
        {"size": [2, 2], "counts": "T"},
        {"size": [2, 2], "counts": "oooooooooo0"},
        {"size": [10**6, 10**6], "counts": "0"},
        {"size": [2, 2], "counts": 4},
    ],
)
def test_nonsense_is_refused(value: dict[str, object]) -> None:
    with pytest.raises(DataError):
        decode_rle(value)


@given(st.lists(st.integers(0, 5000), min_size=1, max_size=40))
def test_compressed_text_is_read_as_pycocotools_reads_it(runs: list[int]) -> None:
    from pycocotools import mask as coco

    size = [sum(runs), 1]
    packed = coco.frPyObjects({"size": size, "counts": runs}, *size)

    mask = decode_rle({"size": size, "counts": packed["counts"]})

    np.testing.assert_array_equal(mask, coco.decode(packed).astype(bool))
    np.testing.assert_array_equal(mask, decode_rle({"size": size, "counts": runs}))


@given(st.text(st.characters(min_codepoint=33, max_codepoint=126), max_size=30))
def test_any_counts_are_read_or_refused(counts: str) -> None:
    with contextlib.suppress(DataError):
        assert decode_rle({"size": [5, 4], "counts": counts}).shape == (5, 4)


def test_the_deepest_point_of_a_ring_lies_on_the_ring() -> None:
    ring = np.zeros((30, 40), bool)
    ring[5:25, 5:25] = True
    ring[8:22, 8:20] = False  # the right side is 5 wide, the others 3
    point = deepest_point(ring)
    assert point is not None
    assert point[0] == 22.5
    assert ring[int(point[1]), int(point[0])]


def test_the_pictures_edge_bounds_a_mask() -> None:
    mask = np.zeros((9, 9), bool)
    mask[:, :5] = True
    point = deepest_point(mask)
    assert point is not None
    assert point.tolist() == [2.5, 2.5]


def test_a_blank_mask_has_neither_box_nor_point() -> None:
    blank = np.zeros((4, 4), bool)
    assert tight_box(blank) is None
    assert deepest_point(blank) is None


def test_iou_of_boxes() -> None:
    box = np.array([0, 0, 4, 2], np.float32)
    others = np.array([[0, 0, 4, 2], [2, 0, 6, 2], [4, 0, 8, 2], [9, 9, 9, 9]], np.float32)
    assert box_area(others).tolist() == [8, 8, 8, 0]
    assert box_overlap(box, others).tolist() == [8, 4, 0, 0]
    assert box_iou(box, others) == pytest.approx([1, 1 / 3, 0, 0])
    assert box_iou(others[3], others[3]) == 0


def test_iou_of_masks() -> None:
    a, b = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    assert iou(a, b) == 1.0
    a[:2] = True
    b[1:3] = True
    assert iou(a, b) == pytest.approx(1 / 3)
    assert iou(a, ~a) == 0.0
