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

_QWEN_SPECIAL = [
    *("<|endoftext|>", "<|im_start|>", "<|im_end|>", "<|object_ref_start|>", "<|object_ref_end|>", "<|box_start|>"),
    *("<|box_end|>", "<|quad_start|>", "<|quad_end|>", "<|vision_start|>", "<|vision_end|>", "<|vision_pad|>"),
    *("<|image_pad|>", "<|video_pad|>"),
]
_CHATML = (
    "{% for message in messages %}{% if loop.first and message['role'] != 'system' %}<|im_start|>system\n"
    "You are a helpful assistant.<|im_end|>\n{% endif %}<|im_start|>{{ message['role'] }}\n"
    "{% if message['content'] is string %}{{ message['content'] }}{% else %}{% for part in message['content'] %}"
    "{% if part['type'] == 'image' %}<|vision_start|><|image_pad|><|vision_end|>"
    "{% elif 'text' in part %}{{ part['text'] }}{% endif %}{% endfor %}{% endif %}<|im_end|>\n"
    "{% endfor %}{% if add_generation_prompt %}<|im_start|>assistant\n{% endif %}"
)


def save_qwen_vl(folder: Path, config: Any = None, *, phrases: Sequence[str] = (), seed: int = 0) -> Path:
    """A Qwen2.5-VL whose vocabulary is the 256 bytes, the special tokens, and whole phrases as one token each."""
    _write_qwen_tokenizer(folder, _byte_vocabulary(), [], {}, _QWEN_SPECIAL, phrases)
    return _save_qwen_model(folder, config, seed)


def save_rex_omni(folder: Path, config: Any = None, *, seed: int = 0) -> Path:
    """A Rex-Omni: a Qwen2.5-VL with coordinate tokens at their published ids.

    The tokenizer's files are as published, trap included: `vocab.json` has ordinary words at the ids of the
    coordinates, which only `tokenizer_config.json` renames.
    """
    vocabulary = _byte_vocabulary()
    for k in range(len(vocabulary), FIRST_COORDINATE_ID):
        vocabulary[f"unused{k}"] = k
    merges: list[str] = []
    letters = sorted(_byte_vocabulary())[:32]
    for k in range(1000):
        left, right = letters[k // 32], letters[k % 32]
        vocabulary[left + right] = FIRST_COORDINATE_ID + k
        merges.append(f"{left} {right}")
    coordinates = {FIRST_COORDINATE_ID + k: f"<{k}>" for k in range(1000)}
    assert len(vocabulary) == SPECIAL_IDS["<|endoftext|>"]
    _write_qwen_tokenizer(folder, vocabulary, merges, coordinates, _QWEN_SPECIAL)
    return _save_qwen_model(folder, config, seed)


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
    _write_clip_tokenizer(folder, length=32)
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
    _write_bert_tokenizer(folder)
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
    _write_clip_tokenizer(folder, length=16)
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


def _save_qwen_model(folder: Path, config: Any, seed: int) -> Path:
    t: Any = require("transformers", extra="local")
    tokenizer = json.loads((folder / "tokenizer_config.json").read_text("utf-8"))
    ids = {token["content"]: int(number) for number, token in tokenizer["added_tokens_decoder"].items()}
    config = config or t.Qwen2_5_VLConfig(
        text_config={
            "vocab_size": max(ids.values()) + 3,
            "hidden_size": 64,
            "intermediate_size": 128,
            "num_hidden_layers": 2,
            "num_attention_heads": 4,
            "num_key_value_heads": 2,
            "max_position_embeddings": 4096,
            "rope_parameters": {"rope_type": "default", "mrope_section": [2, 3, 3], "rope_theta": 1e6},
            "bos_token_id": ids["<|endoftext|>"],
            "eos_token_id": ids["<|im_end|>"],
            "pad_token_id": ids["<|endoftext|>"],
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
        tie_word_embeddings=len(ids) > 1000,  # Rex-Omni's 152 thousand tokens are tied in the published model too
        image_token_id=ids["<|image_pad|>"],
        video_token_id=ids["<|video_pad|>"],
        vision_start_token_id=ids["<|vision_start|>"],
        vision_end_token_id=ids["<|vision_end|>"],
    )
    t.Qwen2VLImageProcessorPil(
        min_pixels=56 * 56, max_pixels=112 * 112, processor_class="Qwen2_5_VLProcessor"
    ).save_pretrained(folder)
    return _save_model(folder, t.Qwen2_5_VLForConditionalGeneration, config, seed)


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


def _byte_vocabulary() -> dict[str, int]:
    """The 256 characters that stand for bytes in byte-level tokenizers, in order."""
    shown = [*range(33, 127), *range(161, 173), *range(174, 256)]
    hidden = [byte for byte in range(256) if byte not in shown]
    return {chr(code): k for k, code in enumerate([*shown, *(256 + k for k in range(len(hidden)))])}


def _write_qwen_tokenizer(
    folder: Path,
    vocabulary: dict[str, int],
    merges: list[str],
    renamed: dict[int, str],
    special: list[str],
    phrases: Sequence[str] = (),
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    added = {**renamed, **{len(vocabulary) + k: name for k, name in enumerate([*special, *phrases])}}
    flags = {"lstrip": False, "normalized": False, "rstrip": False, "single_word": False}
    config: dict[str, Any] = {
        "tokenizer_class": "Qwen2Tokenizer",
        "added_tokens_decoder": {
            str(number): {"content": name, "special": name not in phrases, **flags} for number, name in added.items()
        },
        "eos_token": "<|im_end|>",
        "pad_token": "<|endoftext|>",
        "additional_special_tokens": special[1:],
        "model_max_length": 32768,
    }
    (folder / "vocab.json").write_text(json.dumps(vocabulary, ensure_ascii=False), "utf-8")
    (folder / "merges.txt").write_text("\n".join(["#version: 0.2", *merges]) + "\n", "utf-8")
    (folder / "tokenizer_config.json").write_text(json.dumps(config), "utf-8")
    (folder / "chat_template.jinja").write_text(_CHATML, "utf-8")


def _write_clip_tokenizer(folder: Path, length: int) -> None:
    t: Any = require("transformers", extra="local")
    characters = list(_byte_vocabulary())
    words = [*characters, *(f"{c}</w>" for c in characters), "<|startoftext|>", "<|endoftext|>"]
    t.CLIPTokenizer(
        vocab={word: k for k, word in enumerate(words)}, merges=[], model_max_length=length
    ).save_pretrained(folder)


def _write_bert_tokenizer(folder: Path) -> None:
    t: Any = require("transformers", extra="local")
    letters = "abcdefghijklmnopqrstuvwxyz"
    words = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", ".", *letters, *(f"##{c}" for c in letters)]
    t.BertTokenizer(vocab={word: k for k, word in enumerate(words)}).save_pretrained(folder)
