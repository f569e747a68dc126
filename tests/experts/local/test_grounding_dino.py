"""Grounding DINO and MM-Grounding-DINO: boxes as the library's own post-processing gives them, whatever the batch."""

from __future__ import annotations

import numpy as np
import pytest

from a4agent.errors import ConfigError, ModelFilesError
from a4agent.experts.local import grounding_dino
from a4agent.protocols import DetectRequest

torch = pytest.importorskip("torch")


@pytest.fixture(scope="module", params=["grounding-dino", "mm-grounding-dino"])
def detector(request):
    mm = request.param == "mm-grounding-dino"
    folder = request.getfixturevalue("tiny_mm_grounding_dino" if mm else "tiny_grounding_dino")
    create = grounding_dino.create_mm if mm else grounding_dino.create
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


def test_points_are_derived_and_said_to_be(detector, noise):
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
    detector = grounding_dino.create_mm(str(tiny_mm_grounding_dino), "detector", threshold=0.99)
    found = detector.detect([DetectRequest(noise(96, 64), "mug")])[0]
    assert (found.boxes_xyxy.shape, found.points_xy.shape, found.scores.shape) == ((0, 4), (0, 2), (0,))


def test_a_long_instruction_is_cut_and_not_an_error(detector, noise):
    found = detector.detect([DetectRequest(noise(96, 64), "the handle of the mug " * 50)])[0]
    assert found.boxes_xyxy.shape[1] == 4


def test_captions_are_lower_case_with_one_full_stop():
    assert grounding_dino.as_caption(" The handle.  of the Mug. ") == "the handle of the mug."


def test_mistakes_are_named(tiny_grounding_dino, tiny_mm_grounding_dino):
    with pytest.raises(ModelFilesError, match="is a checkpoint of 'mm-grounding-dino'"):
        grounding_dino.create(str(tiny_mm_grounding_dino), "detector")
    with pytest.raises(ConfigError, match="threshold"):
        grounding_dino.create(str(tiny_grounding_dino), "detector", threshold=2.0)
    with pytest.raises(ModelFilesError, match="a4 models pull IDEA-Research/grounding-dino-tiny"):
        grounding_dino.create("IDEA-Research/grounding-dino-tiny", "detector")
