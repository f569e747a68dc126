"""SAM 2 on a tiny model of the real architecture: batches, caches and sizes change nothing about the masks."""

from __future__ import annotations

import numpy as np
import pytest

from a4agent.errors import ConfigError, ModelFilesError, UnknownNameError
from a4agent.experts.local import sam2
from a4agent.protocols import Prompt, SegmentRequest

torch = pytest.importorskip("torch")


def box(*corners):
    return np.array(corners, np.float32)


def points(*xy):
    return np.array(xy, np.float32).reshape(-1, 2)


PROMPTS = (
    Prompt(box(5, 5, 40, 40), points(20, 20)),
    Prompt(box(1, 1, 9, 9)),
    Prompt(None, points(30, 30)),
    Prompt(box(20, 10, 70, 45), points(50, 30)),
    Prompt(None, points(12, 8, 70, 40)),
    Prompt(box(2, 2, 60, 44)),
)


def count_calls(segmenter, monkeypatch):
    """The number of images in each encoding, and of prompts in each decode."""
    segmenter.load()
    encoded, decoded = [], []
    encode, forward = segmenter._model.get_image_embeddings, segmenter._model.forward

    def counted_encode(pixels, **options):
        encoded.append(len(pixels))
        return encode(pixels, **options)

    def counted_forward(**inputs):
        given = inputs.get("input_boxes", inputs.get("input_points"))
        decoded.append(given.shape[1])
        return forward(**inputs)

    monkeypatch.setattr(segmenter._model, "get_image_embeddings", counted_encode)
    monkeypatch.setattr(segmenter._model, "forward", counted_forward)
    return encoded, decoded


@pytest.mark.parametrize("candidates", ["best", "all"])
def test_all_prompts_at_once_equal_one_by_one(tiny_sam2, noise, candidates):
    segmenter = sam2.create(str(tiny_sam2), "segmenter", candidates=candidates)
    image = noise(80, 48)
    together = segmenter.segment([SegmentRequest(image, PROMPTS)])[0]
    assert together.masks.shape == (6, 1 if candidates == "best" else 3, 48, 80)
    assert together.predicted_iou.shape == together.masks.shape[:2]
    for k, prompt in enumerate(PROMPTS):
        alone = sam2.create(str(tiny_sam2), "segmenter", candidates=candidates)
        single = alone.segment([SegmentRequest(image, (prompt,))])[0]
        np.testing.assert_array_equal(single.masks[0], together.masks[k])
        np.testing.assert_allclose(single.predicted_iou[0], together.predicted_iou[k], atol=1e-6)
    assert len(np.unique(together.masks.reshape(len(together.masks), -1), axis=0)) == 6


def test_agrees_with_the_library_one_prompt_at_a_time(tiny_sam2, noise):
    """The same masks as Sam2Model from pixels, written out without a cache or groups."""
    import torch
    from transformers import Sam2Model

    image = noise(80, 48)
    model = Sam2Model.from_pretrained(tiny_sam2).eval()
    pixels = sam2.to_square(image, 64, *sam2.IMAGENET)
    ours = sam2.create(str(tiny_sam2), "segmenter").segment([SegmentRequest(image, PROMPTS)])[0]
    scale = np.array([64 / 80, 64 / 48], np.float32)
    for k, prompt in enumerate(PROMPTS):
        inputs = {}
        if len(prompt.points_xy):
            inputs["input_points"] = torch.tensor((prompt.points_xy * scale)[None, None])
            inputs["input_labels"] = torch.ones(inputs["input_points"].shape[:3], dtype=torch.int64)
        if prompt.box_xyxy is not None:
            inputs["input_boxes"] = torch.tensor((prompt.box_xyxy * np.tile(scale, 2))[None, None])
        with torch.no_grad():
            output = model(pixel_values=pixels, multimask_output=True, **inputs)
        best = int(output.iou_scores[0, 0].argmax())
        logits = torch.nn.functional.interpolate(
            output.pred_masks[0, :, best : best + 1], size=(48, 80), mode="bilinear"
        )
        np.testing.assert_array_equal(ours.masks[k, 0], (logits[0, 0] > 0).numpy())
        assert ours.predicted_iou[k, 0] == pytest.approx(float(output.iou_scores[0, 0, best]), abs=1e-6)


def test_the_published_kind_of_checkpoint_is_one_for_video(tiny_sam2_video, noise, recwarn, capfd):
    from safetensors.torch import load_file

    segmenter = sam2.create(str(tiny_sam2_video), "segmenter")
    assert segmenter.segment([SegmentRequest(noise(80, 48), PROMPTS)])[0].masks.shape == (6, 1, 48, 80)
    assert segmenter.checkpoint.kind == "sam2_video"
    saved, ours = load_file(tiny_sam2_video / "model.safetensors"), segmenter._model.state_dict()
    assert all((saved[name] == ours[name]).all() for name in ours if name in saved)
    assert len(ours.keys() & saved.keys()) > 0.9 * len(ours)
    assert not recwarn.list
    assert "You are using a model of type" not in capfd.readouterr().err


def test_preprocessing_is_that_of_the_checkpoints_processor(noise):
    """Resize with antialias, then ImageNet's mean and deviation; against Pillow, which shares no code with it."""
    image = noise(90, 50)
    tensor = sam2.to_square(image, 32, *sam2.IMAGENET)[0].permute(1, 2, 0).numpy()
    resized = np.asarray(image.resize((32, 32), 2), np.float32) / 255
    expected = (resized - np.array(sam2.IMAGENET[0])) / np.array(sam2.IMAGENET[1])
    assert np.abs(tensor - expected).max() < 1.01 / 255 / 0.224


def test_preprocessing_equals_the_librarys_processor(tiny_sam2, noise):
    pytest.importorskip("torchvision")
    from transformers import Sam2ImageProcessor

    image = noise(300, 170)
    expected = Sam2ImageProcessor()(images=image, return_tensors="pt")["pixel_values"]
    assert (sam2.to_square(image, 1024, *sam2.IMAGENET) - expected).abs().max() < 1e-6


def test_an_image_is_encoded_once(tiny_sam2, noise, monkeypatch):
    segmenter = sam2.create(str(tiny_sam2), "segmenter")
    encoded, decoded = count_calls(segmenter, monkeypatch)
    first = segmenter.segment([SegmentRequest(noise(80, 48), PROMPTS[:1])])[0]
    again = segmenter.segment([SegmentRequest(noise(80, 48), PROMPTS[:1])])[0]  # equal pixels, another object
    np.testing.assert_array_equal(first.masks, again.masks)
    segmenter.segment([SegmentRequest(noise(80, 48), PROMPTS)])
    assert encoded == [1]
    assert decoded == [1, 1, 2, 2, 1, 1]  # at the end: both boxes with a point, both boxes, one point, two points


def test_prepare_encodes_ahead_and_the_cache_forgets_the_oldest(tiny_sam2, noise, monkeypatch):
    segmenter = sam2.create(str(tiny_sam2), "segmenter", cached_images=2, max_batch=2)
    encoded, _ = count_calls(segmenter, monkeypatch)
    a, b, c = (noise(80, 48, seed) for seed in range(3))
    segmenter.prepare([a, b])
    assert encoded == [2]
    segmenter.segment([SegmentRequest(a, PROMPTS[:1]), SegmentRequest(b, PROMPTS[:1])])
    assert encoded == [2]
    segmenter.segment([SegmentRequest(c, PROMPTS[:1])])  # a is the oldest now, and goes
    segmenter.segment([SegmentRequest(b, PROMPTS[:1])])
    assert encoded == [2, 1]
    segmenter.segment([SegmentRequest(a, PROMPTS[:1])])
    assert encoded == [2, 1, 1]


def test_a_batch_larger_than_the_cache_is_answered(tiny_sam2, noise):
    images = [noise(60 + 4 * k, 48, k) for k in range(4)]
    batch = sam2.create(str(tiny_sam2), "segmenter", cached_images=0, max_batch=4)
    answers = batch.segment([SegmentRequest(image, PROMPTS[:2]) for image in images])
    for image, answer in zip(images, answers, strict=True):
        assert answer.masks.shape == (2, 1, image.height, image.width)
        alone = sam2.create(str(tiny_sam2), "segmenter").segment([SegmentRequest(image, PROMPTS[:2])])[0]
        assert np.mean(answer.masks != alone.masks) < 1e-3


def test_out_of_memory_halves_the_batch_and_goes_on(tiny_sam2, noise, monkeypatch):
    import torch

    segmenter = sam2.create(str(tiny_sam2), "segmenter", max_batch=8)
    encoded, _ = count_calls(segmenter, monkeypatch)
    encode = segmenter._model.get_image_embeddings

    def small_memory(pixels, **options):
        if len(pixels) > 2:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB")
        return encode(pixels, **options)

    monkeypatch.setattr(segmenter._model, "get_image_embeddings", small_memory)
    answers = segmenter.segment([SegmentRequest(noise(80, 48, k), PROMPTS[:1]) for k in range(7)])
    assert [answer.masks.shape for answer in answers] == [(1, 1, 48, 80)] * 7
    assert encoded == [1] * 7  # 7 fail, then 3 fail, then one at a time


def test_many_prompts_are_decoded_in_chunks(tiny_sam2, noise, monkeypatch):
    monkeypatch.setattr(sam2, "_PROMPTS_AT_ONCE", 3)
    segmenter = sam2.create(str(tiny_sam2), "segmenter")
    _, decoded = count_calls(segmenter, monkeypatch)
    prompts = tuple(Prompt(box(k, k, k + 20, k + 15)) for k in range(7))
    answer = segmenter.segment([SegmentRequest(noise(80, 48), prompts)])[0]
    assert decoded == [3, 3, 1]
    assert answer.masks.shape == (7, 1, 48, 80)


def test_half_precision_is_for_the_encoder(tiny_sam2, noise):
    half, full = (sam2.create(str(tiny_sam2), "segmenter", dtype=dtype) for dtype in ("bfloat16", "float32"))
    for segmenter in (half, full):
        segmenter.prepare([noise(80, 48)])
    (rounded,), (exact,) = half._embeddings.values(), full._embeddings.values()
    assert all(level.dtype == torch.float32 for level in rounded)
    assert not torch.equal(rounded[0], exact[0])
    torch.testing.assert_close(rounded[0], exact[0], atol=0.1, rtol=0.1)


def test_half_precision_keeps_the_prompts_exact(tiny_sam2, noise):
    """Boxes one pixel apart in a large image differ in bfloat16 too: only the encoder runs in it."""
    segmenter = sam2.create(str(tiny_sam2), "segmenter", dtype="bfloat16")
    near = (Prompt(box(700, 600, 1001, 701)), Prompt(box(700, 600, 1002, 701)))
    answer = segmenter.segment([SegmentRequest(noise(1024, 768), near)])[0]
    assert answer.predicted_iou[0, 0] != answer.predicted_iou[1, 0]
    exact = sam2.create(str(tiny_sam2), "segmenter").segment([SegmentRequest(noise(1024, 768), near)])[0]
    np.testing.assert_allclose(answer.predicted_iou, exact.predicted_iou, atol=0.02)


def test_what_changes_an_answer_is_in_the_fingerprint(tiny_sam2):
    def fingerprint(**settings):
        return sam2.create(str(tiny_sam2), "segmenter", **settings).fingerprint()

    assert fingerprint() == fingerprint(max_batch=1, cached_images=0)
    assert fingerprint() != fingerprint(dtype="bfloat16")
    assert fingerprint() != fingerprint(candidates="all")


def test_mistakes_are_named(tiny_sam2, tiny_grounding_dino):
    with pytest.raises(UnknownNameError, match=r"model of 'sam2': 'larg'; did you mean 'large'"):
        sam2.create("larg", "segmenter")
    with pytest.raises(ModelFilesError, match=r"facebook/sam2.1-hiera-tiny"):
        sam2.create("tiny", "segmenter")
    with pytest.raises(ModelFilesError, match="is a checkpoint of 'grounding-dino'"):
        sam2.create(str(tiny_grounding_dino), "segmenter")
    with pytest.raises(UnknownNameError, match="candidates"):
        sam2.create(str(tiny_sam2), "segmenter", candidates="bset")
    with pytest.raises(UnknownNameError, match="dtype"):
        sam2.create(str(tiny_sam2), "segmenter", dtype="bf16")
    with pytest.raises(ConfigError, match="max_batch"):
        sam2.create(str(tiny_sam2), "segmenter", max_batch=0)
    with pytest.raises(ConfigError, match="device 'nonsense'"):
        sam2.create(str(tiny_sam2), "segmenter", device="nonsense")


def test_closing_lets_go_and_the_next_call_loads_again(tiny_sam2, noise):
    segmenter = sam2.create(str(tiny_sam2), "segmenter")
    request = SegmentRequest(noise(80, 48), PROMPTS[:1])
    before = segmenter.segment([request])[0]
    segmenter.close()
    segmenter.close()
    assert segmenter._model is None
    segmenter.prepare([noise(80, 48)])  # a thread of a run that is over comes late
    assert segmenter._model is None
    np.testing.assert_array_equal(segmenter.segment([request])[0].masks, before.masks)
