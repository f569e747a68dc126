"""Detectors that score boxes: which boxes are kept, and the answers of transformers' own post-processing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as stn

from a4agent.errors import ConfigError, ModelFilesError
from a4agent.experts.local.open_vocabulary import (
    BoxSelection,
    GroundingDino,
    MMGroundingDino,
    Owlv2,
    as_caption,
    best_boxes,
    centres,
    to_corners,
)
from a4agent.protocols import DetectRequest

torch = pytest.importorskip("torch")

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
def test_suppression_keeps_the_better_of_overlapping_boxes(boxes, limit, seed):
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


@pytest.fixture(scope="module", params=["grounding-dino", "mm-grounding-dino"])
def detector(request):
    mm = request.param == "mm-grounding-dino"
    folder = request.getfixturevalue("tiny_mm_grounding_dino" if mm else "tiny_grounding_dino")
    create = MMGroundingDino if mm else GroundingDino
    return create(str(folder), "detector", threshold=0.01, max_boxes=100)


def test_agrees_with_the_librarys_post_processing(detector, noise):
    """The contract with transformers: scores, boxes, and the size of the original image."""
    image = noise(96, 64)
    found = detector.detect([DetectRequest(image, "The handle of the mug.")])[0]
    inputs = detector._processor(images=image, text=[["the handle of the mug"]], return_tensors="pt")
    with torch.no_grad():
        output = detector._model(**inputs)
    expected = detector._processor.post_process_grounded_object_detection(
        output, inputs["input_ids"], threshold=0.01, text_threshold=0.01, target_sizes=[(64, 96)]
    )[0]
    order = expected["scores"].argsort(descending=True, stable=True)
    assert len(order) > 1
    np.testing.assert_allclose(found.scores, expected["scores"][order].numpy(), rtol=1e-5)
    np.testing.assert_allclose(found.boxes_xyxy, expected["boxes"][order].numpy(), rtol=1e-4, atol=1e-3)


def test_points_are_marked_as_derived(detector, noise):
    found = detector.detect([DetectRequest(noise(96, 64), "mug")])[0]
    assert found.points_derived
    np.testing.assert_allclose(found.points_xy, (found.boxes_xyxy[:, :2] + found.boxes_xyxy[:, 2:]) / 2, rtol=1e-5)


def test_batched_answers_equal_single_ones_whatever_the_sizes(detector, noise):
    phrases = ("mug", "the handle of the mug", "spout", "x")
    sizes = ((96, 64), (50, 90), (96, 64), (90, 50))
    requests = [DetectRequest(noise(*size, k), p) for k, (size, p) in enumerate(zip(sizes, phrases, strict=True))]
    for request, answer in zip(requests, detector.detect(requests), strict=True):
        alone = detector.detect([request])[0]
        np.testing.assert_allclose(answer.scores, alone.scores, atol=1e-5)
        np.testing.assert_allclose(answer.boxes_xyxy, alone.boxes_xyxy, atol=1e-3)


def test_nothing_above_the_threshold_is_an_empty_answer(tiny_mm_grounding_dino, noise):
    detector = MMGroundingDino(str(tiny_mm_grounding_dino), "detector", threshold=0.99)
    found = detector.detect([DetectRequest(noise(96, 64), "mug")])[0]
    assert (found.boxes_xyxy.shape, found.points_xy.shape, found.scores.shape) == ((0, 4), (0, 2), (0,))


def test_a_long_instruction_is_cut_and_not_an_error(detector, noise):
    found = detector.detect([DetectRequest(noise(96, 64), "the handle of the mug " * 50)])[0]
    assert found.boxes_xyxy.shape[1] == 4


def test_captions_are_lower_case_with_one_full_stop():
    assert as_caption(" The handle.  of the Mug. ") == "the handle of the mug."


def test_mistakes_are_named(tiny_grounding_dino, tiny_mm_grounding_dino):
    with pytest.raises(ModelFilesError, match="is a checkpoint of 'mm-grounding-dino'"):
        GroundingDino(str(tiny_mm_grounding_dino), "detector")
    with pytest.raises(ConfigError, match="threshold"):
        GroundingDino(str(tiny_grounding_dino), "detector", threshold=2.0)
    with pytest.raises(ModelFilesError, match="a4 models pull IDEA-Research/grounding-dino-tiny"):
        GroundingDino("IDEA-Research/grounding-dino-tiny", "detector")


@pytest.fixture(scope="module")
def owlv2(tiny_owlv2):
    return Owlv2(str(tiny_owlv2), "detector", threshold=0.0, nms_iou=1.0, max_boxes=100)


@pytest.mark.parametrize("size_wh", [(96, 64), (50, 90)])
def test_owlv2_agrees_with_the_librarys_post_processing(owlv2, noise, size_wh):
    """The contract with transformers: the image is padded to a square, so both axes scale by the longer side."""
    image = noise(*size_wh)
    found = owlv2.detect([DetectRequest(image, "the handle of the mug")])[0]
    inputs = owlv2._processor(images=image, text=[["the handle of the mug"]], truncation=True, return_tensors="pt")
    with torch.no_grad():
        output = owlv2._model(**inputs)
    expected = owlv2._processor.post_process_grounded_object_detection(
        output, threshold=0.0, target_sizes=[size_wh[::-1]]
    )[0]
    order = expected["scores"].argsort(descending=True, stable=True)
    assert len(order) == 16
    np.testing.assert_allclose(found.scores, expected["scores"][order].numpy(), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(found.boxes_xyxy, expected["boxes"][order].numpy(), rtol=1e-4, atol=1e-3)


def test_a_point_is_the_patch_that_saw_the_box_or_its_centre(owlv2, noise):
    size_wh = (96, 64)
    output = type("Output", (), {})()
    output.logits = torch.linspace(-3, 3, 16).reshape(1, 16, 1)
    around = torch.tensor([[0.375, 0.125, 0.3, 0.3]])  # about the middle of patch 1, in units of the square
    elsewhere = torch.tensor([[0.9, 0.9, 0.1, 0.1]])
    output.pred_boxes = torch.cat([elsewhere, around, *[elsewhere] * 14])[None]
    found = owlv2.candidates_of(output, 0, size_wh)
    np.testing.assert_allclose(found.points_xy[1], [0.375 * 96, 0.125 * 96])
    np.testing.assert_allclose(found.points_xy[0], [0.9 * 96, 0.9 * 96], rtol=1e-6)
    assert owlv2.detect([DetectRequest(noise(*size_wh), "mug")])[0].points_derived


def test_owlv2_answers_alike_alone_and_in_a_batch(owlv2, noise):
    requests = [
        DetectRequest(noise(96, 64, k), phrase) for k, phrase in enumerate(("mug", "the long handle of it", "x"))
    ]
    for request, answer in zip(requests, owlv2.detect(requests), strict=True):
        alone = owlv2.detect([request])[0]
        np.testing.assert_allclose(answer.scores, alone.scores, atol=1e-5)
        np.testing.assert_allclose(answer.boxes_xyxy, alone.boxes_xyxy, atol=1e-3)


def test_a_long_phrase_is_cut_to_what_the_text_encoder_takes(owlv2, noise):
    assert len(owlv2.detect([DetectRequest(noise(96, 64), "handle " * 40)])[0].boxes_xyxy) == 16
