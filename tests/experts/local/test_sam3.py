"""SAM 3 in both its roles, on tiny models of the real architecture."""

from __future__ import annotations

import numpy as np
import pytest

from a4agent.errors import ConfigError, ModelFilesError
from a4agent.experts import registry
from a4agent.experts.local import sam3
from a4agent.protocols import DetectRequest, Prompt, SegmentRequest

torch = pytest.importorskip("torch")


@pytest.fixture(scope="module")
def detector(tiny_sam3):
    return sam3.create(str(tiny_sam3), "detector", threshold=0.0)


def test_a_phrase_becomes_boxes_scores_and_masks_at_the_images_size(detector, noise):
    found = detector.detect([DetectRequest(noise(96, 64), "handle")])[0]
    assert found.boxes_xyxy.shape == (12, 4)
    assert found.masks.shape == (12, 64, 96)
    assert found.masks.dtype == bool
    assert found.points_xy.shape == (0, 2)
    assert (np.diff(found.scores) <= 0).all()
    assert found.boxes_xyxy.max() > 1  # pixels, not units


def test_agrees_with_the_librarys_arithmetic(detector, noise):
    """Scores times presence, masks where the resized probability is above a half (as the checkpoint's processor)."""
    image = noise(96, 64)
    found = detector.detect([DetectRequest(image, "handle")])[0]
    words = detector._tokenizer(["handle"], padding="max_length", max_length=32, return_tensors="pt")
    with torch.no_grad():
        output = detector._model(pixel_values=sam3.to_square(image, 112, *sam3.HALF), **words)
    scores = (output.pred_logits.sigmoid() * output.presence_logits.sigmoid())[0]
    order = scores.argsort(descending=True)
    np.testing.assert_allclose(found.scores, scores[order].numpy(), rtol=1e-5)
    np.testing.assert_allclose(
        found.boxes_xyxy, (output.pred_boxes[0, order] * torch.tensor([96, 64, 96, 64])).numpy(), rtol=1e-4
    )
    probability = torch.nn.functional.interpolate(output.pred_masks.sigmoid(), size=(64, 96), mode="bilinear")[0, order]
    assert np.mean(found.masks != (probability > 0.5).numpy()) < 1e-4


def test_batched_answers_equal_single_ones(detector, noise):
    requests = [DetectRequest(noise(96, 64, 0), "handle"), DetectRequest(noise(50, 90, 1), "the long spout of it")]
    for request, answer in zip(requests, detector.detect(requests), strict=True):
        alone = detector.detect([request])[0]
        np.testing.assert_allclose(answer.scores, alone.scores, atol=1e-5)
        np.testing.assert_allclose(answer.boxes_xyxy, alone.boxes_xyxy, atol=1e-2)
        assert np.mean(answer.masks != alone.masks) < 1e-3


def test_nothing_above_the_threshold_is_an_empty_answer(tiny_sam3, noise):
    found = sam3.create(str(tiny_sam3), "detector", threshold=0.99).detect([DetectRequest(noise(96, 64), "mug")])[0]
    assert (found.boxes_xyxy.shape, found.scores.shape, found.masks.shape) == ((0, 4), (0,), (0, 64, 96))


def test_as_segmenter_it_takes_boxes_and_points(tiny_sam3_tracker, noise):
    segmenter = registry.create(f"sam3:{tiny_sam3_tracker}", "segmenter")
    prompts = (
        Prompt(np.array([5, 5, 40, 40], np.float32), np.array([[20, 20]], np.float32)),
        Prompt(None, np.array([[30, 30]], np.float32)),
    )
    together = segmenter.segment([SegmentRequest(noise(80, 48), prompts)])[0]
    assert together.masks.shape == (2, 1, 48, 80)
    for k, prompt in enumerate(prompts):
        alone = segmenter.segment([SegmentRequest(noise(80, 48), (prompt,))])[0]
        np.testing.assert_array_equal(alone.masks[0], together.masks[k])


def test_the_published_checkpoint_plays_both_roles(tiny_sam3_video, noise, recwarn):
    from safetensors.torch import load_file

    saved = load_file(tiny_sam3_video / "model.safetensors")
    segmenter = sam3.create(str(tiny_sam3_video), "segmenter")
    prompts = (Prompt(np.array([5, 5, 40, 40], np.float32)),)
    assert segmenter.segment([SegmentRequest(noise(80, 48), prompts)])[0].masks.shape == (1, 1, 48, 80)
    name = "mask_decoder.conv_s0.weight"
    assert torch.equal(segmenter._model.state_dict()[name], saved[f"tracker_model.{name}"])
    detector = sam3.create(str(tiny_sam3_video), "detector", threshold=0.0)
    assert detector.detect([DetectRequest(noise(80, 48), "handle")])[0].masks.shape == (12, 48, 80)
    name = "text_projection.weight"
    assert torch.equal(detector._model.state_dict()[name], saved[f"detector_model.{name}"])
    assert not recwarn.list


def test_mistakes_are_named(tiny_sam3, tiny_sam2):
    with pytest.raises(ModelFilesError, match="is a checkpoint of 'sam2'; 'sam3' or 'sam3_video'"):
        sam3.create(str(tiny_sam2), "detector")
    with pytest.raises(ConfigError, match="threshold"):
        sam3.create(str(tiny_sam3), "detector", threshold=1.5)
    with pytest.raises(ConfigError, match="cannot be the vlm"):
        registry.create(f"sam3:{tiny_sam3}", "vlm")
    with pytest.raises(ModelFilesError, match="a4 models pull facebook/sam3"):
        sam3.create("facebook/sam3", "detector")
