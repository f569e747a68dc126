"""A tiny Qwen-Image-Edit pipeline of the real classes, from a folder: settings, steps, seeds, LoRA and positions."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from a4agent.errors import ConfigError, ModelFilesError, UnknownNameError
from a4agent.experts.local import image_edit as qwen_image_edit
from a4agent.experts.local.base import Placement
from a4agent.protocols import EditRequest

torch = pytest.importorskip("torch")
pytest.importorskip("diffusers")

SMALL = {"steps": 2, "output_pixels": 64 * 96}


@pytest.fixture(autouse=True)
def _small_pictures(monkeypatch):
    """The pipeline's own sizes (384 x 384 for the text encoder, 1024 x 1024 for the autoencoder), shrunk."""
    from diffusers.pipelines.qwenimage import pipeline_qwenimage_edit_plus as module

    monkeypatch.setattr(module, "VAE_IMAGE_SIZE", 64 * 64)
    monkeypatch.setattr(module, "CONDITION_IMAGE_SIZE", 112 * 112)


@pytest.fixture(scope="module")
def editor(tiny_qwen_image_edit):
    return qwen_image_edit.create(str(tiny_qwen_image_edit), "editor", **SMALL)


def edit(editor, image, prompt="Show a hand gripping the handle.", **options):
    return np.asarray(editor.edit([EditRequest(image, prompt, **options)])[0].image)


def test_an_edit_depends_on_picture_prompt_and_seed_and_on_nothing_else(editor, noise):
    image = noise(96, 64)
    first = edit(editor, image)
    assert first.shape == (64, 96, 3)
    np.testing.assert_array_equal(first, edit(editor, image))
    assert (first != edit(editor, image, "Something else.")).any()
    assert (first != edit(editor, image, seed=1)).any()
    assert (first != edit(editor, noise(96, 64, 1))).any()


def test_several_requests_are_edited_one_at_a_time(editor, noise):
    requests = [EditRequest(noise(96, 64, k), "Show a hand.") for k in range(2)]
    together = editor.edit(requests)
    for request, answer in zip(requests, together, strict=True):
        np.testing.assert_array_equal(np.asarray(answer.image), edit(editor, request.image, request.prompt))
        assert answer.usage.seconds > 0
    assert editor.max_batch == 1


def test_each_step_is_reported(editor, noise):
    steps = []
    edit(editor, noise(96, 64), on_step=lambda done, total: steps.append((done, total)))
    assert steps == [(1, 2), (2, 2)]


def test_the_authors_settings_are_the_defaults(tiny_qwen_image_edit, noise, monkeypatch):
    editor = qwen_image_edit.create(str(tiny_qwen_image_edit), "editor")
    editor.load()
    seen = {}

    def pipeline(**options):
        seen.update(options)
        return type("Output", (), {"images": [noise(32, 32)]})

    editor._model = pipeline
    edit(editor, noise(160, 90))
    assert seen["num_inference_steps"] == 30
    assert seen["true_cfg_scale"] == 4.0
    assert seen["negative_prompt"] == " "
    assert seen["generator"].initial_seed() == 0
    assert (seen["width"], seen["height"]) == (1376, 768)


def test_lightning_takes_its_schedule_and_no_negative_prompt(tiny_qwen_image_edit, lora_file, noise, monkeypatch):
    plain = qwen_image_edit.create(str(tiny_qwen_image_edit), "editor", true_cfg_scale=1.0, steps=4, output_pixels=6144)
    options = {"lightning": 4, "lora": str(lora_file), "output_pixels": 6144}
    editor = qwen_image_edit.create(str(tiny_qwen_image_edit), "editor", **options)
    passes = []
    editor.load()
    editor._model.transformer.register_forward_hook(lambda *_: passes.append(1))
    picture = edit(editor, noise(96, 64))
    assert len(passes) == 4  # instead of 2 * 30
    assert (picture != edit(plain, noise(96, 64))).any()
    config = editor._model.scheduler.config
    assert config.base_shift == config.max_shift == pytest.approx(np.log(3))
    assert config.shift_terminal is None
    assert config.use_dynamic_shifting
    assert config.time_shift_type == "exponential"
    assert editor.fingerprint() != plain.fingerprint()


def test_a_lora_changes_the_picture(tiny_qwen_image_edit, lora_file, editor, noise):
    with_lora = qwen_image_edit.create(str(tiny_qwen_image_edit), "editor", lora=str(lora_file), **SMALL)
    assert (edit(with_lora, noise(96, 64)) != edit(editor, noise(96, 64))).any()


def test_a_lora_that_was_trained_on_has_another_fingerprint(tiny_qwen_image_edit, lora_file, tmp_path):
    lora = tmp_path / "lora.safetensors"

    def fingerprint(data):
        lora.write_bytes(data)
        return qwen_image_edit.create(str(tiny_qwen_image_edit), "editor", lora=str(lora), **SMALL).fingerprint()

    data = lora_file.read_bytes()
    assert fingerprint(data) == fingerprint(data) != fingerprint(data[:-1] + b"\x01")


@pytest.fixture(scope="module")
def lora_file(tiny_qwen_image_edit, tmp_path_factory):
    """A LoRA for the tiny transformer, saved by the pipeline's own method."""
    peft = pytest.importorskip("peft")
    from diffusers import QwenImageEditPlusPipeline, QwenImageTransformer2DModel

    torch.manual_seed(0)
    transformer = QwenImageTransformer2DModel.from_pretrained(tiny_qwen_image_edit / "transformer")
    config = peft.LoraConfig(r=4, target_modules=["to_q", "to_k"], init_lora_weights=False)
    transformer.add_adapter(config)
    layers = peft.get_peft_model_state_dict(transformer)
    folder = tmp_path_factory.mktemp("lora")
    QwenImageEditPlusPipeline.save_lora_weights(folder, transformer_lora_layers=layers)
    return folder / "pytorch_lora_weights.safetensors"


def text_encoder_calls(editor, noise):
    calls = []
    editor.load()
    encoder = editor._model.text_encoder
    watch = encoder.model.register_forward_pre_hook(lambda _, args, kwargs: calls.append(kwargs), with_kwargs=True)
    edit(editor, noise(96, 96))
    watch.remove()
    return encoder, calls


def test_the_text_encoder_learns_which_tokens_are_of_the_picture(editor, noise):
    encoder, calls = text_encoder_calls(editor, noise)
    assert calls
    for call in calls:
        assert torch.equal(call["mm_token_type_ids"].bool(), call["input_ids"] == encoder.config.image_token_id)


def test_the_position_fix_is_still_needed(tiny_qwen_image_edit, noise, monkeypatch):
    """Fails on the day diffusers passes mm_token_type_ids itself: `supply_token_types` can go then."""
    monkeypatch.setattr(qwen_image_edit, "supply_token_types", lambda encoder: None)
    bare = qwen_image_edit.create(str(tiny_qwen_image_edit), "editor", **SMALL)
    _, calls = text_encoder_calls(bare, noise)
    assert all(call.get("mm_token_type_ids") is None for call in calls)


def test_the_fix_leaves_token_types_that_are_given_alone():
    class Encoder(torch.nn.Module):
        def forward(self, input_ids=None, image_grid_thw=None, mm_token_type_ids=None):
            return mm_token_type_ids

    class OldEncoder(torch.nn.Module):
        def forward(self, input_ids=None, image_grid_thw=None):
            return "old"

    encoder, old = Encoder(), OldEncoder()
    encoder.config = type("Config", (), {"image_token_id": 7})
    for module in (encoder, old):
        qwen_image_edit.supply_token_types(module)
    ids = torch.tensor([[1, 7, 7, 2]])
    assert encoder(input_ids=ids, image_grid_thw=ids).tolist() == [[0, 1, 1, 0]]
    assert encoder(input_ids=ids, image_grid_thw=ids, mm_token_type_ids=ids) is ids
    assert encoder(input_ids=ids) is None
    assert old(input_ids=ids, image_grid_thw=ids) == "old"


@pytest.mark.parametrize("size_wh", [(4000, 3000), (90, 160), (1000, 1000), (3000, 100)])
def test_output_size_keeps_area_and_proportions(size_wh):
    width, height = qwen_image_edit.output_size(size_wh, 1024 * 1024)
    assert width % 32 == height % 32 == 0
    assert width * height == pytest.approx(1024 * 1024, rel=0.1)
    assert width / height == pytest.approx(size_wh[0] / size_wh[1], rel=0.1)


def test_mistakes_are_named(tiny_qwen_image_edit, tiny_sam2, tmp_path, monkeypatch):
    folder = str(tiny_qwen_image_edit)

    def create(model=folder, **settings):
        return qwen_image_edit.create(model, "editor", **settings)

    with pytest.raises(ConfigError, match="no Lightning LoRA is known for"):
        create(lightning=4)
    with pytest.raises(ConfigError, match="lightning is 0"):
        create(lightning=6)
    with pytest.raises(UnknownNameError, match="offload 'modle'; did you mean 'model'"):
        create(offload="modle")
    with pytest.raises(ConfigError, match="from an accelerator"):
        create(offload="model", device="cpu")
    monkeypatch.setitem(sys.modules, "bitsandbytes", sys)
    with pytest.raises(ConfigError, match="needs a GPU"):
        create(quantisation="4bit", device="cpu")
    with pytest.raises(ConfigError, match="steps"):
        create(steps=0)
    with pytest.raises(ConfigError, match="cannot be spread"):
        create(device="spread")
    with pytest.raises(ModelFilesError, match="there is no file"):
        create(lora=str(tmp_path / "lora.safetensors"))
    with pytest.raises(ModelFilesError, match=r"'QwenImageEditPlusPipeline' or .* is needed"):
        create(str(tiny_sam2))
    with pytest.raises(ModelFilesError, match="a4 models pull Qwen/Qwen-Image-Edit-2509"):
        create("Qwen/Qwen-Image-Edit-2509")


def test_a_lora_of_another_model_is_a_files_error(tiny_qwen_image_edit, tiny_sam2):
    editor = qwen_image_edit.create(
        str(tiny_qwen_image_edit), "editor", lora=str(tiny_sam2 / "model.safetensors"), **SMALL
    )
    with pytest.raises(ModelFilesError, match="cannot be loaded"):
        editor.load()


@pytest.mark.parametrize(
    ("offload", "advice"),
    [("none", "offload = 'model'"), ("model", "offload = 'sequential'"), ("sequential", "quanti")],
)
def test_what_needs_less_memory_than_now_is_advised(tiny_qwen_image_edit, monkeypatch, offload, advice):
    monkeypatch.setattr(qwen_image_edit, "place", lambda *_: Placement("cuda", "bfloat16"))
    editor = qwen_image_edit.create(str(tiny_qwen_image_edit), "editor", offload=offload)
    assert editor.shrinking[0].startswith(advice)


def test_flux2_klein_edits_in_four_steps(tiny_flux2_klein, noise):
    editor = qwen_image_edit.create(str(tiny_flux2_klein), "editor", output_pixels=64 * 64)
    steps = []
    request = EditRequest(
        noise(96, 64), "Show a hand.", seed=3, on_step=lambda done, total: steps.append((done, total))
    )
    first, again = editor.edit([request, request])
    assert steps[:4] == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert first.image.size == qwen_image_edit.output_size((96, 64), 64 * 64)
    assert first.image.tobytes() == again.image.tobytes()
    other = editor.edit([EditRequest(noise(96, 64), "Show a hand.", seed=4)])[0]
    assert other.image.tobytes() != first.image.tobytes()
    assert editor.fingerprint()["settings"]["guidance_scale"] == 1.0


def test_qwen_image_2_1_edits_without_guidance(tiny_qwen_image_21, noise):
    editor = qwen_image_edit.create(str(tiny_qwen_image_21), "editor", steps=2, output_pixels=64 * 64)
    requests = [EditRequest(noise(96, 64), "Show a hand.", seed=seed) for seed in (3, 3, 4)]
    first, again, other = (answer.image for answer in editor.edit(requests))
    assert first.size == qwen_image_edit.output_size((96, 64), 64 * 64)
    assert first.mode == "RGB"
    assert first.tobytes() == again.tobytes()
    assert first.tobytes() != other.tobytes()
    assert editor.fingerprint()["settings"]["true_cfg_scale"] == 1.0
    guided = qwen_image_edit.create(
        str(tiny_qwen_image_21), "editor", steps=2, output_pixels=64 * 64, true_cfg_scale=4.0, negative_prompt="blur"
    )
    assert guided.edit(requests[:1])[0].image.tobytes() != first.tobytes()


@pytest.mark.parametrize(
    ("setting", "value"), [("true_cfg_scale", 4.0), ("negative_prompt", "blurry"), ("lightning", 4)]
)
def test_a_setting_that_the_pipeline_does_not_take_is_named(tiny_flux2_klein, setting, value):
    with pytest.raises(ConfigError, match=f"a Flux2KleinPipeline, which takes no '{setting}'"):
        qwen_image_edit.create(str(tiny_flux2_klein), "editor", **{setting: value})


def test_qwens_editor_takes_no_guidance_scale(tiny_qwen_image_edit):
    with pytest.raises(ConfigError, match="takes no 'guidance_scale'"):
        qwen_image_edit.create(str(tiny_qwen_image_edit), "editor", guidance_scale=2.5)
