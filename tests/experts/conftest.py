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
        from a4agent.experts import random_weights

        label = "-".join([name, *options])
        return getattr(random_weights, f"save_{name}")(tmp_path_factory.mktemp("checkpoints") / label, **options)

    return checkpoint


tiny_qwen_vl = _fixture("qwen_vl")
tiny_qwen3_vl = _fixture("qwen3_vl")
tiny_internvl3 = _fixture("internvl3")
tiny_rex_omni = _fixture("rex_omni")
tiny_sam2 = _fixture("sam2")
tiny_sam3 = _fixture("sam3")
tiny_sam3_tracker = _fixture("sam3_tracker")
tiny_grounding_dino = _fixture("grounding_dino")
tiny_mm_grounding_dino = _fixture("grounding_dino", mm=True)
tiny_owlv2 = _fixture("owlv2")
tiny_qwen_image_edit = _fixture("qwen_image_edit")


PHRASE = "the handle of the mug"
BINS = ((100, 200, 700, 800), (0, 0, 500, 999))
POINT = (400, 500)


@pytest.fixture(scope="session")
def taught_rex_omni(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Rex-Omni that has learnt to find PHRASE in a picture: the boxes BINS and the POINT, in bins of 999."""
    _torch_ready()
    from a4agent.experts import random_weights, rex_omni
    from a4agent.experts.local_chat import Turn
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
