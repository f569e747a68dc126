"""Checkpoints of the real architectures with random weights: to test the experts, or measure them, without a download.

    save_sam2(folder)                       # 0.2 M parameters
    save_sam2(folder, transformers.Sam2Config(...))       # any size

Each folder holds what the published checkpoint holds and is loaded through the same `from_pretrained`. The
answers mean nothing; shapes, devices, batches, caches, time and memory are those of the real thing.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from a4agent.errors import require
from a4agent.experts.rex_omni_answer import FIRST_COORDINATE_ID, SPECIAL_IDS
from random_tokenizers import byte_vocabulary, write_bert_tokenizer, write_clip_tokenizer, write_qwen_tokenizer


def save_qwen_vl(folder: Path, config: Any = None, *, phrases: Sequence[str] = (), seed: int = 0) -> Path:
    """A Qwen2.5-VL whose vocabulary is the 256 bytes, the special tokens, and whole phrases as one token each."""
    return _save_qwen_model(folder, config, write_qwen_tokenizer(folder, phrases=phrases), seed)


def save_qwen3_vl(folder: Path, config: Any = None, *, seed: int = 0) -> Path:
    """A Qwen3-VL."""
    t: Any = require("transformers", extra="local")
    ids = write_qwen_tokenizer(folder)
    t.Qwen2VLImageProcessorPil(min_pixels=64 * 64, max_pixels=128 * 128, patch_size=16).save_pretrained(folder)
    config = config or t.Qwen3VLConfig(
        text_config={
            **_tiny_text(ids),
            "head_dim": 16,
            "rope_parameters": {"rope_type": "default", "mrope_section": [4, 2, 2], "rope_theta": 1e6},
        },
        vision_config={
            "depth": 2,
            "hidden_size": 32,
            "intermediate_size": 64,
            "num_heads": 4,
            "out_hidden_size": 64,
            "patch_size": 16,
            "num_position_embeddings": 64,
            "deepstack_visual_indexes": [0, 1],
        },
        image_token_id=ids["<|image_pad|>"],
        video_token_id=ids["<|video_pad|>"],
        vision_start_token_id=ids["<|vision_start|>"],
        vision_end_token_id=ids["<|vision_end|>"],
    )
    return _save_model(folder, t.Qwen3VLForConditionalGeneration, config, seed)


def save_qwen3_5(folder: Path, *, seed: int = 0) -> Path:
    """A Qwen3.5: three layers of linear attention to one of full attention, and a chat template with thinking."""
    t: Any = require("transformers", extra="local")
    ids = write_qwen_tokenizer(folder)
    t.Qwen2Tokenizer.from_pretrained(folder).save_pretrained(folder)  # as tokenizer.json, the only file that is read
    t.Qwen2VLImageProcessorPil(min_pixels=64 * 64, max_pixels=128 * 128, patch_size=16).save_pretrained(folder)
    text = {key: value for key, value in _tiny_text(ids).items() if key not in ("rope_parameters", "layer_types")}
    config = t.Qwen3_5Config(
        text_config={
            **text,
            "num_hidden_layers": 4,
            "head_dim": 16,
            "linear_key_head_dim": 8,
            "linear_value_head_dim": 8,
            "linear_num_key_heads": 2,
            "linear_num_value_heads": 2,
            "rope_parameters": {
                "rope_type": "default",
                "mrope_section": [2, 1, 1],
                "rope_theta": 1e6,
                "partial_rotary_factor": 0.5,
            },
        },
        vision_config={
            "depth": 2,
            "hidden_size": 32,
            "intermediate_size": 64,
            "num_heads": 4,
            "out_hidden_size": 64,
            "patch_size": 16,
            "num_position_embeddings": 64,
        },
        image_token_id=ids["<|image_pad|>"],
        video_token_id=ids["<|video_pad|>"],
        vision_start_token_id=ids["<|vision_start|>"],
        vision_end_token_id=ids["<|vision_end|>"],
    )
    return _save_model(folder, t.Qwen3_5ForConditionalGeneration, config, seed)


def save_internvl3(folder: Path, config: Any = None, *, seed: int = 0) -> Path:
    """An InternVL3."""
    t: Any = require("transformers", extra="local")
    named = {
        "start_image_token": "<img>",
        "end_image_token": "</img>",
        "context_image_token": "<IMG_CONTEXT>",
        "video_token": "<video>",
    }
    special = ["<|endoftext|>", "<|im_start|>", "<|im_end|>", *named.values()]
    ids = write_qwen_tokenizer(folder, special=special, named=named, image="<IMG_CONTEXT>\n")
    t.GotOcr2ImageProcessorPil(size={"height": 56, "width": 56}, max_patches=4).save_pretrained(folder)
    processor = {"processor_class": "InternVLProcessor", "image_seq_length": 4}
    (folder / "processor_config.json").write_text(json.dumps(processor), "utf-8")
    config = config or t.InternVLConfig(
        text_config={**_tiny_text(ids), "model_type": "qwen2"},
        vision_config={
            "hidden_size": 32,
            "intermediate_size": 64,
            "num_hidden_layers": 2,
            "num_attention_heads": 4,
            "image_size": [56, 56],
            "patch_size": [14, 14],
        },
        image_token_id=ids["<IMG_CONTEXT>"],
        image_seq_length=4,
        tie_word_embeddings=False,
    )
    return _save_model(folder, t.InternVLForConditionalGeneration, config, seed)


def save_rex_omni(folder: Path, config: Any = None, *, seed: int = 0) -> Path:
    """A Rex-Omni: a Qwen2.5-VL with coordinate tokens at their published ids.

    The tokenizer's files are as published, trap included: `vocab.json` has ordinary words at the ids of the
    coordinates, which only `tokenizer_config.json` renames.
    """
    vocabulary = byte_vocabulary()
    for k in range(len(vocabulary), FIRST_COORDINATE_ID):
        vocabulary[f"unused{k}"] = k
    merges: list[str] = []
    letters = sorted(byte_vocabulary())[:32]
    for k in range(1000):
        left, right = letters[k // 32], letters[k % 32]
        vocabulary[left + right] = FIRST_COORDINATE_ID + k
        merges.append(f"{left} {right}")
    coordinates = {FIRST_COORDINATE_ID + k: f"<{k}>" for k in range(1000)}
    assert len(vocabulary) == SPECIAL_IDS["<|endoftext|>"]
    ids = write_qwen_tokenizer(folder, vocabulary, merges, renamed=coordinates)
    return _save_qwen_model(folder, config, ids, seed)


def save_sam2(folder: Path, config: Any = None, *, seed: int = 0) -> Path:
    """A SAM 2; by default one of 0.2 M parameters that sees 64 x 64 pixels."""
    t: Any = require("transformers", extra="local")
    if config is None:
        side = 64
        config = t.Sam2Config(
            vision_config=t.Sam2VisionConfig(
                backbone_config=t.Sam2HieraDetConfig(
                    hidden_size=12,
                    num_attention_heads=1,
                    image_size=[side, side],
                    blocks_per_stage=[1, 1, 2, 1],
                    embed_dim_per_stage=[12, 24, 48, 96],
                    num_attention_heads_per_stage=[1, 1, 2, 4],
                    window_size_per_stage=[8, 4, 4, 2],
                    global_attention_blocks=[3],
                    window_positional_embedding_background_size=[7, 7],
                ),
                backbone_channel_list=[96, 48, 24, 12],
                backbone_feature_sizes=[[side // 4] * 2, [side // 8] * 2, [side // 16] * 2],
                fpn_hidden_size=32,
            ),
            prompt_encoder_config=t.Sam2PromptEncoderConfig(
                hidden_size=32, image_size=side, patch_size=16, mask_input_channels=8
            ),
            mask_decoder_config=t.Sam2MaskDecoderConfig(
                hidden_size=32, mlp_dim=64, num_attention_heads=2, iou_head_hidden_dim=32
            ),
        )
    return _save_model(folder, t.Sam2Model, config, seed)


def save_sam3_tracker(folder: Path, config: Any = None, *, seed: int = 0) -> Path:
    """SAM 3's tracker: the half that takes boxes and points."""
    t: Any = require("transformers", extra="local")
    if config is None:
        config = t.Sam3TrackerConfig(
            vision_config=_tiny_sam3_vision(),
            prompt_encoder_config={"hidden_size": 32, "image_size": 112, "patch_size": 14, "mask_input_channels": 8},
            mask_decoder_config={
                "hidden_size": 32,
                "mlp_dim": 64,
                "num_attention_heads": 2,
                "iou_head_hidden_dim": 32,
            },
        )
    return _save_model(folder, t.Sam3TrackerModel, config, seed)


def save_sam3(folder: Path, config: Any = None, *, seed: int = 0) -> Path:
    """SAM 3's detector: the half that takes a phrase."""
    t: Any = require("transformers", extra="local")
    write_clip_tokenizer(folder, length=32)
    if config is None:
        small = {"hidden_size": 32, "num_attention_heads": 2}
        config = t.Sam3Config(
            vision_config=_tiny_sam3_vision(),
            text_config=_tiny_clip_text() | {"projection_dim": 32, "max_position_embeddings": 32},
            geometry_encoder_config={**small, "num_layers": 1, "intermediate_size": 64},
            detr_encoder_config={**small, "num_layers": 1, "intermediate_size": 64},
            detr_decoder_config={**small, "num_layers": 2, "intermediate_size": 64, "num_queries": 12},
            mask_decoder_config=small,
        )
    return _save_model(folder, t.Sam3Model, config, seed)


def save_grounding_dino(folder: Path, config: Any = None, *, mm: bool = False, seed: int = 0) -> Path:
    """A Grounding DINO, or an MM-Grounding-DINO."""
    t: Any = require("transformers", extra="local")
    write_bert_tokenizer(folder)
    t.GroundingDinoImageProcessorPil(size={"shortest_edge": 96, "longest_edge": 128}).save_pretrained(folder)
    if config is None:
        config = (t.MMGroundingDinoConfig if mm else t.GroundingDinoConfig)(
            backbone_config=t.SwinConfig(
                window_size=7,
                image_size=224,
                embed_dim=24,
                depths=[1, 1, 2, 1],
                num_heads=[1, 2, 4, 8],
                out_features=["stage2", "stage3", "stage4"],
                out_indices=[2, 3, 4],
            ),
            text_config=t.BertConfig(
                hidden_size=32, num_hidden_layers=2, num_attention_heads=4, intermediate_size=37, vocab_size=64
            ).to_dict(),
            d_model=32,
            encoder_layers=2,
            decoder_layers=2,
            encoder_ffn_dim=16,
            decoder_ffn_dim=16,
            encoder_attention_heads=4,
            decoder_attention_heads=4,
            num_queries=20,
            use_timm_backbone=False,
            backbone=None,
        )
    cls = t.MMGroundingDinoForObjectDetection if mm else t.GroundingDinoForObjectDetection
    return _save_model(folder, cls, config, seed)


def save_owlv2(folder: Path, config: Any = None, *, seed: int = 0) -> Path:
    """An OWLv2."""
    t: Any = require("transformers", extra="local")
    write_clip_tokenizer(folder, length=16)
    t.Owlv2ImageProcessorPil(size={"height": 32, "width": 32}).save_pretrained(folder)
    if config is None:
        vision = {"hidden_size": 32, "intermediate_size": 37, "num_hidden_layers": 2, "num_attention_heads": 4}
        config = t.Owlv2Config(
            text_config=_tiny_clip_text() | {"max_position_embeddings": 16},
            vision_config={**vision, "image_size": 32, "patch_size": 8},
            projection_dim=32,
        )
    return _save_model(folder, t.Owlv2ForObjectDetection, config, seed)


def save_qwen_image_edit(folder: Path, *, transformer: Any = None, vae: Any = None, seed: int = 0) -> Path:
    """A Qwen-Image-Edit pipeline (its text encoder is a tiny Qwen2.5-VL unless `text_encoder/` is there already)."""
    torch: Any = require("torch", extra="local")
    d: Any = require("diffusers", extra="local")
    text_encoder = folder / "text_encoder"
    if not text_encoder.exists():
        save_qwen_vl(text_encoder, seed=seed)
    for name in ("tokenizer", "processor"):
        (folder / name).mkdir(parents=True, exist_ok=True)
        for file in text_encoder.iterdir():
            if not file.name.startswith(("model", "config", "generation")):
                (folder / name / file.name).write_bytes(file.read_bytes())
    torch.manual_seed(seed)
    latents = 4
    parts: dict[str, Any] = {
        "transformer": transformer
        or d.QwenImageTransformer2DModel(
            patch_size=2,
            in_channels=4 * latents,
            out_channels=latents,
            num_layers=2,
            attention_head_dim=16,
            num_attention_heads=3,
            joint_attention_dim=64,
            guidance_embeds=False,
            axes_dims_rope=(8, 4, 4),
        ),
        "vae": vae
        or d.AutoencoderKLQwenImage(
            base_dim=24,
            z_dim=latents,
            dim_mult=[1, 2, 4],
            num_res_blocks=1,
            temperal_downsample=[False, True],
            latents_mean=[0.0] * latents,
            latents_std=[1.0] * latents,
        ),
        "scheduler": d.FlowMatchEulerDiscreteScheduler(),
    }
    index = {"_class_name": "QwenImageEditPlusPipeline", "_diffusers_version": d.__version__}
    index |= {name: ["diffusers", type(part).__name__] for name, part in parts.items()}
    index["text_encoder"] = ["transformers", "Qwen2_5_VLForConditionalGeneration"]
    index["tokenizer"] = ["transformers", "Qwen2Tokenizer"]
    index["processor"] = ["transformers", "Qwen2VLProcessor"]
    for name, part in parts.items():
        part.save_pretrained(folder / name)
    (folder / "model_index.json").write_text(json.dumps(index), "utf-8")
    return folder


def save_qwen_image_21(folder: Path, *, seed: int = 0) -> Path:
    """A Qwen-Image 2.1 pipeline: a tiny Qwen3-VL, one block, a small VAE whose pictures have four channels."""
    torch: Any = require("torch", extra="local")
    d: Any = require("diffusers", extra="local")
    t: Any = require("transformers", extra="local")
    text_encoder = save_qwen3_vl(folder / "text_encoder", seed=seed)
    (folder / "processor").mkdir(parents=True, exist_ok=True)
    for file in text_encoder.iterdir():
        if not file.name.startswith(("model", "config", "generation")):
            (folder / "processor" / file.name).write_bytes(file.read_bytes())
    # The text encoder must see as many patches as the VAE, so nothing may be scaled down on the way to it.
    t.Qwen2VLImageProcessorPil(max_pixels=2048 * 2048, patch_size=16).save_pretrained(folder / "processor")
    torch.manual_seed(seed)
    latents = 4
    parts: dict[str, Any] = {
        "transformer": d.QwenImage21Transformer2DModel(
            in_channels=latents,
            out_channels=latents,
            num_layers=1,
            attention_head_dim=16,
            num_attention_heads=2,
            context_in_dim=64,
            axes_dims_rope=(4, 6, 6),
        ),
        "vae": d.AutoencoderKLQwenImage21(
            base_dim=4,
            decoder_base_dim=4,
            z_dim=latents,
            dim_mult=[1, 1, 1, 1, 1],
            num_res_blocks=1,
            latents_mean=[0.0] * latents,
            latents_std=[1.0] * latents,
        ),
        "scheduler": d.FlowMatchEulerDiscreteScheduler(use_dynamic_shifting=True),
    }
    index = {"_class_name": "QwenImage21Pipeline", "_diffusers_version": d.__version__}
    index |= {name: ["diffusers", type(part).__name__] for name, part in parts.items()}
    index["text_encoder"] = ["transformers", "Qwen3VLForConditionalGeneration"]
    index["processor"] = ["transformers", "Qwen3VLProcessor"]
    for name, part in parts.items():
        part.save_pretrained(folder / name)
    (folder / "model_index.json").write_text(json.dumps(index), "utf-8")
    return folder


def save_flux2_klein(folder: Path, *, seed: int = 0) -> Path:
    """A FLUX.2 klein pipeline: a Qwen3 of 28 narrow layers (three are read), 2 blocks, a small VAE."""
    torch: Any = require("torch", extra="local")
    d: Any = require("diffusers", extra="local")
    t: Any = require("transformers", extra="local")
    torch.manual_seed(seed)
    ids = write_qwen_tokenizer(folder / "tokenizer")
    width, latents = 16, 4
    text = t.Qwen3Config(
        vocab_size=max(ids.values()) + 1,
        hidden_size=width,
        intermediate_size=16,
        num_hidden_layers=28,
        num_attention_heads=2,
        num_key_value_heads=1,
        head_dim=8,
    )
    parts: dict[str, Any] = {
        "text_encoder": t.Qwen3ForCausalLM(text),
        "transformer": d.Flux2Transformer2DModel(
            in_channels=4 * latents,
            num_layers=1,
            num_single_layers=1,
            attention_head_dim=16,
            num_attention_heads=2,
            joint_attention_dim=3 * width,
            timestep_guidance_channels=16,
            axes_dims_rope=(4, 4, 4, 4),
            guidance_embeds=False,
        ),
        "vae": d.AutoencoderKLFlux2(
            down_block_types=("DownEncoderBlock2D", "DownEncoderBlock2D"),
            up_block_types=("UpDecoderBlock2D", "UpDecoderBlock2D"),
            block_out_channels=(8, 8),
            layers_per_block=1,
            latent_channels=latents,
            norm_num_groups=4,
            sample_size=32,
        ),
        "scheduler": d.FlowMatchEulerDiscreteScheduler(use_dynamic_shifting=True),
    }
    index = {"_class_name": "Flux2KleinPipeline", "_diffusers_version": d.__version__, "is_distilled": True}
    index |= {name: ["diffusers", type(part).__name__] for name, part in parts.items() if name != "text_encoder"}
    index["text_encoder"] = ["transformers", "Qwen3ForCausalLM"]
    index["tokenizer"] = ["transformers", "Qwen2Tokenizer"]
    for name, part in parts.items():
        part.save_pretrained(folder / name)
    (folder / "model_index.json").write_text(json.dumps(index), "utf-8")
    return folder


def _save_qwen_model(folder: Path, config: Any, ids: dict[str, int], seed: int) -> Path:
    t: Any = require("transformers", extra="local")
    config = config or t.Qwen2_5_VLConfig(
        text_config={
            **_tiny_text(ids),
            "rope_parameters": {"rope_type": "default", "mrope_section": [2, 3, 3], "rope_theta": 1e6},
        },
        vision_config={
            "depth": 2,
            "hidden_size": 32,
            "intermediate_size": 64,
            "num_heads": 4,
            "out_hidden_size": 64,
            "patch_size": 14,
            "spatial_merge_size": 2,
            "temporal_patch_size": 2,
            "window_size": 112,
            "fullatt_block_indexes": [1],
        },
        tie_word_embeddings=max(ids.values()) > 100_000,  # Rex-Omni's tokens, tied in the published model too
        image_token_id=ids["<|image_pad|>"],
        video_token_id=ids["<|video_pad|>"],
        vision_start_token_id=ids["<|vision_start|>"],
        vision_end_token_id=ids["<|vision_end|>"],
    )
    t.Qwen2VLImageProcessorPil(
        min_pixels=56 * 56, max_pixels=112 * 112, processor_class="Qwen2_5_VLProcessor"
    ).save_pretrained(folder)
    return _save_model(folder, t.Qwen2_5_VLForConditionalGeneration, config, seed)


def _tiny_text(ids: dict[str, int]) -> dict[str, Any]:
    return {
        "vocab_size": max(ids.values()) + 3,
        "hidden_size": 64,
        "intermediate_size": 128,
        "num_hidden_layers": 2,
        "num_attention_heads": 4,
        "num_key_value_heads": 2,
        "max_position_embeddings": 4096,
        "bos_token_id": ids["<|endoftext|>"],
        "eos_token_id": ids["<|im_end|>"],
        "pad_token_id": ids["<|endoftext|>"],
    }


def _save_model(folder: Path, cls: Any, config: Any, seed: int) -> Path:
    torch: Any = require("torch", extra="local")
    torch.manual_seed(seed)
    cls(config).save_pretrained(folder)
    return folder


def _tiny_sam3_vision() -> dict[str, Any]:
    return {
        "model_type": "sam3_vision_model",
        "backbone_config": {
            "model_type": "sam3_vit_model",
            "hidden_size": 32,
            "intermediate_size": 64,
            "num_hidden_layers": 2,
            "num_attention_heads": 2,
            "image_size": 112,
            "pretrain_image_size": 56,
            "window_size": 4,
            "global_attn_indexes": [1],
        },
        "fpn_hidden_size": 32,
        "backbone_feature_sizes": [[32, 32], [16, 16], [8, 8]],
    }


def _tiny_clip_text() -> dict[str, Any]:
    return {
        "model_type": "clip_text_model",
        "vocab_size": 600,
        "hidden_size": 32,
        "intermediate_size": 37,
        "num_hidden_layers": 2,
        "num_attention_heads": 4,
        "bos_token_id": 512,
        "eos_token_id": 513,
    }
