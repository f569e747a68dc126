"""The whole agent on four real experts, from a profile, without a download: prompt, edit, think, detect, segment.

The models are tiny ones of the real architectures. The vision-language model and Rex-Omni have been taught what to
answer (see teaching.py); the editor and SAM 2 are random. Nothing between the models is replaced.
"""

from __future__ import annotations

import json

import numpy as np
import pytest

import random_weights
from a4agent import A4Agent, prompts
from a4agent.experts.local import image_edit as qwen_image_edit
from a4agent.experts.local import transformers_vlm
from a4agent.experts.local.generation import Turn
from a4agent.protocols import EditRequest

pytest.importorskip("torch")
pytest.importorskip("diffusers")

INSTRUCTION = "drink from the mug"
PART = "the handle of the mug"  # what the taught Rex-Omni finds
EDIT_PROMPT = "Edit the input image to show a hand gripping the handle of the mug."
ANSWER = (
    "### Thinking\nA mug is held by its handle.\n### Output\n"
    + json.dumps({"task": INSTRUCTION, "object_name": "mug", "object_part": PART})
)  # fmt: skip
EDITOR = {"steps": 2, "output_pixels": 64 * 96}


@pytest.fixture(scope="module", autouse=True)
def _small_pictures():
    """The pipeline's own sizes (384 x 384 for the text encoder, 1024 x 1024 for the autoencoder), shrunk."""
    from diffusers.pipelines.qwenimage import pipeline_qwenimage_edit_plus as module

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "VAE_IMAGE_SIZE", 64 * 64)
        patch.setattr(module, "CONDITION_IMAGE_SIZE", 112 * 112)
        yield


@pytest.fixture(scope="module")
def photo():
    pixels = np.random.default_rng(0).integers(0, 256, (64, 96, 3), dtype=np.uint8)  # the picture Rex-Omni knows
    from PIL import Image

    return Image.fromarray(pixels)


@pytest.fixture(scope="module")
def taught_vlm(tmp_path_factory, tiny_qwen_image_edit, photo):
    """A Qwen2.5-VL that writes EDIT_PROMPT when asked as a Dreamer and ANSWER when asked as a Thinker."""
    from teaching import teach

    dream = prompts.fill(prompts.load("paper", "dreamer"), INSTRUCTION)
    think = prompts.fill(prompts.load("paper", "thinker"), INSTRUCTION)
    folder = tmp_path_factory.mktemp("checkpoints") / "taught-vlm"
    # Questions and answers are one token each, or every step of the training would read 2,600 characters.
    random_weights.save_qwen_vl(folder, phrases=[dream, think, EDIT_PROMPT, ANSWER])
    editor = qwen_image_edit.create(str(tiny_qwen_image_edit), "editor", **EDITOR)
    imagined = editor.edit([EditRequest(photo, EDIT_PROMPT)])[0].image
    editor.close()
    vlm = transformers_vlm.create(str(folder), "vlm")
    vlm.load()
    lessons = [(Turn((photo,), dream), EDIT_PROMPT), (Turn((photo, imagined), think), ANSWER)]
    teach(vlm._model, lessons, folder)
    return folder


@pytest.fixture(scope="module")
def agent(tmp_path_factory, taught_vlm, tiny_qwen_image_edit, taught_rex_omni, tiny_sam2):
    profile = tmp_path_factory.mktemp("profile") / "tiny.toml"
    profile.write_text(
        f"""
[profile]
summary = "four real experts with tiny weights"
[dreamer]
vlm = 'transformers:{taught_vlm}'
editor = {{ expert = 'qwen-image-edit:{tiny_qwen_image_edit}', steps = 2, output_pixels = 6144 }}
[thinker]
vlm = 'transformers:{taught_vlm}'
[spotter]
detector = {{ expert = 'rex-omni:{taught_rex_omni}', max_new_tokens = 64 }}
segmenter = 'sam2:{tiny_sam2}'
""",
        "utf-8",
    )
    with A4Agent.from_profile(profile) as agent:
        yield agent


def test_from_a_picture_and_an_instruction_to_masks(agent, photo):
    heard = []
    steps = []
    affordance = agent.predict(
        photo,
        INSTRUCTION,
        on_stage=lambda name, value: heard.append(name),
        on_step=lambda done, total: steps.append((done, total)),
    )
    assert affordance.status == "ok", affordance.error
    assert heard == ["imagination", "target", "detection", "affordance"]
    assert affordance.imagination.prompt == EDIT_PROMPT
    assert affordance.imagination.image.size == (96, 64)
    assert steps == [(1, 2), (2, 2)]
    assert affordance.target.object_part == PART
    assert affordance.target.thinking == "A mug is held by its handle."
    expected = np.array([[100, 200, 700, 800], [0, 0, 500, 999]]) / 999 * [96, 64, 96, 64]
    np.testing.assert_allclose(affordance.boxes_xyxy, expected, atol=1e-3)
    np.testing.assert_allclose(affordance.points_xy, np.array([[400, 500]]) / 999 * [96, 64], atol=1e-3)
    assert [region.mask.shape for region in affordance.regions] == [(64, 96)] * 2
    assert affordance.mask.any()
    asked = [(step.stage, step.role) for step in affordance.trace.steps]
    assert asked == [
        *(("dreamer", "vlm"), ("dreamer", "editor"), ("thinker", "vlm")),
        *(("spotter", "detector"), ("spotter", "segmenter")),
    ]
    assert all(step.seconds > 0 for step in affordance.trace.steps)


def test_the_dreamer_and_the_thinker_share_one_model(agent):
    assert len(agent.experts()) == 4


def test_through_the_engine_it_is_the_same(agent, photo):
    alone = agent.predict(photo, INSTRUCTION)
    for affordance in agent.predict_many([(photo, INSTRUCTION), (photo, INSTRUCTION)]):
        assert affordance.status == "ok", affordance.error
        np.testing.assert_array_equal(affordance.mask, alone.mask)


def test_an_untaught_model_gives_an_invalid_answer_and_not_an_exception(agent, photo, tiny_qwen_vl):
    from dataclasses import replace

    untaught = transformers_vlm.create(str(tiny_qwen_vl), "vlm")
    confused = replace(agent, dreamer=None, thinker=replace(agent.thinker, vlm=untaught, max_tokens=24, reasks=1))
    affordance = confused.predict(photo, INSTRUCTION)
    assert affordance.status == "invalid"
    assert "gave no usable answer" in affordance.error
    assert [step.stage for step in affordance.trace.steps] == ["thinker", "thinker"]
