"""Tiny checkpoints of the real architectures, saved once a session and loaded as users load theirs."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image


def _torch_ready() -> None:
    torch = pytest.importorskip("torch")
    torch.set_num_threads(1)  # threads cost more than they bring for models this small
    if importlib.util.find_spec("torchvision") is not None:
        _declare_torchvision_operators(torch)
    logging = pytest.importorskip("transformers.utils.logging")
    logging.disable_progress_bar()


def _declare_torchvision_operators(torch: Any) -> None:
    """Beside a CPU build of torch, torchvision of the index misses its compiled half and fails to import."""
    try:
        import torchvision  # noqa: F401
    except RuntimeError:
        for name in ("nms", "qnms"):
            torch.library.define(f"torchvision::{name}", "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")


def _fixture(name: str, **options: Any) -> Callable[..., Path]:
    @pytest.fixture(scope="session")
    def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
        _torch_ready()
        import random_weights

        label = "-".join([name, *options])
        return getattr(random_weights, f"save_{name}")(tmp_path_factory.mktemp("checkpoints") / label, **options)

    return checkpoint


tiny_qwen_vl = _fixture("qwen_vl")
tiny_qwen3_vl = _fixture("qwen3_vl")
tiny_qwen3_5 = _fixture("qwen3_5")
tiny_internvl3 = _fixture("internvl3")
tiny_rex_omni = _fixture("rex_omni")
tiny_sam2 = _fixture("sam2")
tiny_sam3 = _fixture("sam3")
tiny_sam3_tracker = _fixture("sam3_tracker")
tiny_grounding_dino = _fixture("grounding_dino")
tiny_mm_grounding_dino = _fixture("grounding_dino", mm=True)
tiny_owlv2 = _fixture("owlv2")
tiny_qwen_image_edit = _fixture("qwen_image_edit")
tiny_flux2_klein = _fixture("flux2_klein")
tiny_qwen_image_21 = _fixture("qwen_image_21")


SMALL_MEMORY = {
    "memory_attention_hidden_size": 32,
    "memory_attention_feed_forward_hidden_size": 64,
    "memory_encoder_hidden_size": 32,
    "memory_encoder_output_channels": 16,
    "mask_downsampler_embed_dim": 32,
    "memory_fuser_embed_dim": 32,
    "memory_fuser_intermediate_dim": 64,
}


def _parts(config: Any) -> dict[str, Any]:
    names = ("vision_config", "prompt_encoder_config", "mask_decoder_config")
    return {name: getattr(config, name).to_dict() for name in names}


@pytest.fixture(scope="session")
def tiny_sam2_video(tmp_path_factory: pytest.TempPathFactory, tiny_sam2: Path) -> Path:
    """SAM 2 as it is published: a model for video, of which pictures need a part."""
    import torch
    import transformers

    folder = tmp_path_factory.mktemp("checkpoints") / "sam2-video"
    image = transformers.Sam2Config.from_pretrained(tiny_sam2)
    torch.manual_seed(0)
    config = transformers.Sam2VideoConfig(**_parts(image), image_size=64, **SMALL_MEMORY)
    transformers.Sam2VideoModel(config).save_pretrained(folder)
    return folder


@pytest.fixture(scope="session")
def tiny_sam3_video(tmp_path_factory: pytest.TempPathFactory, tiny_sam3: Path, tiny_sam3_tracker: Path) -> Path:
    """SAM 3 as it is published: detector and tracker in one checkpoint for video."""
    import torch
    import transformers
    from safetensors.torch import load_file, save_file

    folder = tmp_path_factory.mktemp("checkpoints") / "sam3-video"
    detector = transformers.Sam3Config.from_pretrained(tiny_sam3)
    tracker = transformers.Sam3TrackerConfig.from_pretrained(tiny_sam3_tracker)
    video = transformers.Sam3TrackerVideoConfig(**_parts(tracker), image_size=112, **SMALL_MEMORY)
    torch.manual_seed(0)
    config = transformers.Sam3VideoConfig(detector_config=detector.to_dict(), tracker_config=video.to_dict())
    transformers.Sam3VideoModel(config).save_pretrained(folder)
    weights = load_file(folder / "model.safetensors")
    twice = "tracker_model.tracker_model."  # how transformers 5.23 saves what is published with the prefix once
    weights = {name.replace(twice, "tracker_model."): value for name, value in weights.items()}
    save_file(weights, folder / "model.safetensors", {"format": "pt"})
    for file in tiny_sam3.glob("tokenizer*"):
        (folder / file.name).write_bytes(file.read_bytes())
    return folder


PHRASE = "the handle of the mug"
BINS = ((100, 200, 700, 800), (0, 0, 500, 999))
POINT = (400, 500)


@pytest.fixture(scope="session")
def taught_rex_omni(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Rex-Omni that has learnt to find PHRASE in a picture: the boxes BINS and the POINT, in bins of 999."""
    _torch_ready()
    import random_weights
    from a4agent.experts.local import rex_omni
    from a4agent.experts.local.generation import Turn
    from a4agent.experts.rex_omni_answer import SYSTEM, detection_prompt, pointing_prompt
    from teaching import teach

    folder = random_weights.save_rex_omni(tmp_path_factory.mktemp("checkpoints") / "taught-rex-omni")
    expert = rex_omni.create(str(folder), "detector")
    expert.load()
    photo = noise_picture(96, 64)
    opening = f"<|object_ref_start|>{PHRASE}<|object_ref_end|><|box_start|>"
    boxes = ",".join("".join(f"<{number}>" for number in box) for box in BINS)
    point = "".join(f"<{number}>" for number in POINT)
    lessons = [
        (Turn((photo,), detection_prompt(PHRASE), SYSTEM), f"{opening}{boxes}<|box_end|>"),
        (Turn((photo,), pointing_prompt(PHRASE), SYSTEM), f"{opening}{point}<|box_end|>"),
    ]
    assert expert._model is not None
    teach(expert._model, lessons, folder)
    return folder


def noise_picture(width: int, height: int, seed: int = 0) -> Image.Image:
    pixels = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    return Image.fromarray(pixels)


@pytest.fixture
def noise() -> Callable[..., Image.Image]:
    """noise(width, height, seed): an RGB picture that no other seed gives."""
    return noise_picture
