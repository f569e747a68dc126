"""The SAM 2 tracker on tiny weights: the library's own session gives the same masks, and memory stays level."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from a4agent.experts.local.sam2_video import LOOKS_BACK, Sam2VideoTracker

WIDTH, MEMORY = 128, 64
"""Channels; the attention to memory takes 64, whatever the configuration, and fewer than the features have."""


@pytest.fixture(scope="module")
def tiny_tracker(tmp_path_factory: pytest.TempPathFactory, tiny_sam2: Path) -> Path:
    """A SAM 2 for video that is small and as wide as its memory."""
    import torch
    import transformers

    image = transformers.Sam2Config.from_pretrained(tiny_sam2)
    config = transformers.Sam2VideoConfig(
        vision_config={**image.vision_config.to_dict(), "fpn_hidden_size": WIDTH},
        prompt_encoder_config={**image.prompt_encoder_config.to_dict(), "hidden_size": WIDTH},
        mask_decoder_config={**image.mask_decoder_config.to_dict(), "hidden_size": WIDTH},
        image_size=64,
        memory_attention_hidden_size=WIDTH,
        memory_attention_feed_forward_hidden_size=64,
        memory_attention_rope_feat_sizes=[4, 4],
        memory_encoder_hidden_size=WIDTH,
        memory_encoder_output_channels=MEMORY,
        mask_downsampler_embed_dim=WIDTH,
        memory_fuser_embed_dim=WIDTH,
        memory_fuser_intermediate_dim=64,
    )
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("checkpoints") / "sam2-tracker"
    transformers.Sam2VideoModel(config).save_pretrained(folder)
    return folder


MASK = np.zeros((48, 64), bool)
MASK[10:30, 20:50] = True


def frames(count: int) -> list[Image.Image]:
    rng = np.random.default_rng(0)
    return [Image.fromarray(rng.integers(0, 255, (48, 64, 3), np.uint8).astype(np.uint8)) for _ in range(count)]


def test_it_follows_and_forgets(tiny_tracker: Path) -> None:
    tracker = Sam2VideoTracker(model=str(tiny_tracker), device="cpu")
    first, *rest = frames(LOOKS_BACK + 8)
    tracker.start(first, MASK)
    found = [tracker.step(frame) for frame in rest]
    assert {answer.mask.shape for answer in found} == {(48, 64)}
    assert all(0.0 <= answer.quality <= 1.0 for answer in found)
    session = tracker._session
    assert len(session.processed_frames) == 1
    memories = session.output_dict_per_obj[0]["non_cond_frame_outputs"]
    assert len(memories) <= LOOKS_BACK + 1


def test_dropping_old_frames_changes_no_mask(tiny_tracker: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, *rest = frames(LOOKS_BACK + 6)

    def run() -> list[np.ndarray]:
        tracker = Sam2VideoTracker(model=str(tiny_tracker), device="cpu")
        tracker.start(first, MASK)
        return [tracker.step(frame).mask for frame in rest]

    trimmed = run()
    monkeypatch.setattr("a4agent.experts.local.sam2_video.LOOKS_BACK", 1000)
    for one, other in zip(trimmed, run(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_second_start_follows_the_new_mask_only(tiny_tracker: Path) -> None:
    tracker = Sam2VideoTracker(model=str(tiny_tracker), device="cpu")
    first, second, third = frames(3)
    tracker.start(first, MASK)
    tracker.step(second)
    tracker.start(second, ~MASK)
    again = tracker.step(third)
    fresh = Sam2VideoTracker(model=str(tiny_tracker), device="cpu")
    fresh.start(second, ~MASK)
    np.testing.assert_array_equal(again.mask, fresh.step(third).mask)
    tracker.close()
