"""OWLv2: boxes as the library's own post-processing gives them, and points from the patches that predicted them."""

from __future__ import annotations

import numpy as np
import pytest

from a4agent.experts.local import owlv2
from a4agent.protocols import DetectRequest

torch = pytest.importorskip("torch")


@pytest.fixture(scope="module")
def detector(tiny_owlv2):
    return owlv2.create(str(tiny_owlv2), "detector", threshold=0.0, nms_iou=1.0, max_boxes=100)


@pytest.mark.parametrize("size_wh", [(96, 64), (50, 90)])
def test_agrees_with_the_librarys_post_processing(detector, noise, size_wh):
    """The contract with transformers: the image is padded to a square, so both axes scale by the longer side."""
    image = noise(*size_wh)
    found = detector.detect([DetectRequest(image, "the handle of the mug")])[0]
    inputs = detector._processor(images=image, text=[["the handle of the mug"]], truncation=True, return_tensors="pt")
    with torch.no_grad():
        output = detector._model(**inputs)
    expected = detector._processor.post_process_grounded_object_detection(
        output, threshold=0.0, target_sizes=[size_wh[::-1]]
    )[0]
    order = expected["scores"].argsort(descending=True, stable=True)
    assert len(order) == 16
    np.testing.assert_allclose(found.scores, expected["scores"][order].numpy(), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(found.boxes_xyxy, expected["boxes"][order].numpy(), rtol=1e-4, atol=1e-3)


def test_a_point_is_the_patch_that_saw_the_box_or_its_centre(detector, noise):
    size_wh = (96, 64)
    output = type("Output", (), {})()
    output.logits = torch.linspace(-3, 3, 16).reshape(1, 16, 1)
    around = torch.tensor([[0.375, 0.125, 0.3, 0.3]])  # about the middle of patch 1, in units of the square
    elsewhere = torch.tensor([[0.9, 0.9, 0.1, 0.1]])
    output.pred_boxes = torch.cat([elsewhere, around, *[elsewhere] * 14])[None]
    found = detector.candidates_of(output, 0, size_wh)
    np.testing.assert_allclose(found.points_xy[1], [0.375 * 96, 0.125 * 96])
    np.testing.assert_allclose(found.points_xy[0], [0.9 * 96, 0.9 * 96], rtol=1e-6)
    assert detector.detect([DetectRequest(noise(*size_wh), "mug")])[0].points_derived


def test_batched_answers_equal_single_ones(detector, noise):
    requests = [
        DetectRequest(noise(96, 64, k), phrase) for k, phrase in enumerate(("mug", "the long handle of it", "x"))
    ]
    for request, answer in zip(requests, detector.detect(requests), strict=True):
        alone = detector.detect([request])[0]
        np.testing.assert_allclose(answer.scores, alone.scores, atol=1e-5)
        np.testing.assert_allclose(answer.boxes_xyxy, alone.boxes_xyxy, atol=1e-3)


def test_a_long_phrase_is_cut_to_what_the_text_encoder_takes(detector, noise):
    assert len(detector.detect([DetectRequest(noise(96, 64), "handle " * 40)])[0].boxes_xyxy) == 16
