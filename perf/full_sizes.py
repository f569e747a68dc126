"""The published sizes of the models behind the local experts, as configurations for random weights.

Numbers from the checkpoints' own config.json files: SAM 2.1, SAM 3, Qwen2.5-VL 3B (Rex-Omni) and 7B, Grounding DINO
(Swin-T), OWLv2 (base, patch 16), Qwen-Image-Edit-2509.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import diffusers
import transformers as t

sys.path.append(str(Path(__file__).parent.parent / "tests"))

import random_weights
from a4agent.experts.rex_omni_answer import SPECIAL_IDS

# Width, attention heads, blocks of the four stages, blocks with global attention, windows, grid of window positions.
HIERA: dict[str, tuple[int, int, list[int], list[int], list[int], int]] = {
    "tiny": (96, 1, [1, 2, 7, 2], [5, 7, 9], [8, 4, 14, 7], 7),
    "small": (96, 1, [1, 2, 11, 2], [7, 10, 13], [8, 4, 14, 7], 7),
    "base-plus": (112, 2, [2, 3, 16, 3], [12, 16, 20], [8, 4, 14, 7], 14),
    "large": (144, 2, [2, 6, 36, 4], [23, 33, 43], [8, 4, 16, 8], 7),
}


def sam2_config(size: str) -> t.Sam2Config:
    width, heads, blocks, global_blocks, windows, grid = HIERA[size]
    widths = [width * 2**k for k in range(4)]
    return t.Sam2Config(
        vision_config=t.Sam2VisionConfig(
            backbone_config=t.Sam2HieraDetConfig(
                hidden_size=width,
                num_attention_heads=heads,
                blocks_per_stage=blocks,
                embed_dim_per_stage=widths,
                num_attention_heads_per_stage=[heads * 2**k for k in range(4)],
                window_size_per_stage=windows,
                global_attention_blocks=global_blocks,
                window_positional_embedding_background_size=[grid, grid],
            ),
            backbone_channel_list=widths[::-1],
        )
    )


def qwen_vl_config(size: str, special: dict[str, int]) -> t.Qwen2_5_VLConfig:
    """Qwen2.5-VL of "3B" or "7B"; the ids of the special tokens come from the tokenizer it is saved with."""
    text: dict[str, Any] = {
        "3B": {"hidden_size": 2048, "intermediate_size": 11008, "num_hidden_layers": 36, "num_attention_heads": 16},
        "7B": {"hidden_size": 3584, "intermediate_size": 18944, "num_hidden_layers": 28, "num_attention_heads": 28},
    }[size]
    return t.Qwen2_5_VLConfig(
        text_config={
            **text,
            "num_key_value_heads": {"3B": 2, "7B": 4}[size],
            "vocab_size": 152064,
            "max_position_embeddings": 128000,
            "rope_parameters": {"rope_type": "default", "mrope_section": [16, 24, 24], "rope_theta": 1e6},
            "bos_token_id": special["<|endoftext|>"],
            "eos_token_id": special["<|im_end|>"],
            "pad_token_id": special["<|endoftext|>"],
        },
        vision_config={
            "depth": 32,
            "hidden_size": 1280,
            "intermediate_size": 3420,
            "num_heads": 16,
            "window_size": 112,
            "out_hidden_size": text["hidden_size"],
            "fullatt_block_indexes": [7, 15, 23, 31],
        },
        tie_word_embeddings=size == "3B",
        image_token_id=special["<|image_pad|>"],
        video_token_id=special["<|image_pad|>"] + 1,
        vision_start_token_id=special["<|vision_start|>"],
        vision_end_token_id=special["<|vision_end|>"],
    )


BYTES_SPECIAL = {name: number - SPECIAL_IDS["<|endoftext|>"] + 256 for name, number in SPECIAL_IDS.items()}
"""The special tokens' ids beside a vocabulary of 256 bytes (`random_weights.save_qwen_vl`)."""


def save(name: str, folder: Path, size: str) -> Path:
    """Save the checkpoint `name` with random weights, "tiny" or in its published, "full", size."""
    function = getattr(random_weights, f"save_{name}")
    if size == "tiny":
        return function(folder)
    if name == "qwen_image_edit":
        save("qwen_vl", folder / "text_encoder", size)
        return function(
            folder, transformer=diffusers.QwenImageTransformer2DModel(), vae=diffusers.AutoencoderKLQwenImage()
        )
    return function(folder, _full_config(name))


def _full_config(name: str) -> Any:
    return {
        "qwen_vl": lambda: qwen_vl_config("7B", BYTES_SPECIAL),
        "rex_omni": lambda: qwen_vl_config("3B", SPECIAL_IDS),
        "sam2": lambda: sam2_config("large"),
        "sam3": t.Sam3Config,
        "sam3_tracker": t.Sam3TrackerConfig,
        "grounding_dino": t.GroundingDinoConfig,
        "owlv2": lambda: t.Owlv2Config(vision_config={"image_size": 960, "patch_size": 16}),
    }[name]()
