"""Tiny tokenizers in the files of the published ones: byte-level (Qwen, InternVL), CLIP's and BERT's.

For `random_weights`. A text is one token a character, unless whole phrases are made tokens.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from a4agent.errors import require

QWEN_SPECIAL = [
    *("<|endoftext|>", "<|im_start|>", "<|im_end|>", "<|object_ref_start|>", "<|object_ref_end|>", "<|box_start|>"),
    *("<|box_end|>", "<|quad_start|>", "<|quad_end|>", "<|vision_start|>", "<|vision_end|>", "<|vision_pad|>"),
    *("<|image_pad|>", "<|video_pad|>"),
]
QWEN_IMAGE = "<|vision_start|><|image_pad|><|vision_end|>"
_CHATML = (
    "{% for message in messages %}{% if loop.first and message['role'] != 'system' %}<|im_start|>system\n"
    "You are a helpful assistant.<|im_end|>\n{% endif %}<|im_start|>{{ message['role'] }}\n"
    "{% if message['content'] is string %}{{ message['content'] }}{% else %}{% for part in message['content'] %}"
    "{% if part['type'] == 'image' %}IMAGE"
    "{% elif 'text' in part %}{{ part['text'] }}{% endif %}{% endfor %}{% endif %}<|im_end|>\n"
    "{% endfor %}{% if add_generation_prompt %}<|im_start|>assistant\n{% endif %}"
)


def byte_vocabulary() -> dict[str, int]:
    """The 256 characters that stand for bytes in byte-level tokenizers, in order."""
    shown = [*range(33, 127), *range(161, 173), *range(174, 256)]
    hidden = [byte for byte in range(256) if byte not in shown]
    return {chr(code): k for k, code in enumerate([*shown, *(256 + k for k in range(len(hidden)))])}


def write_qwen_tokenizer(
    folder: Path,
    vocabulary: dict[str, int] | None = None,
    merges: Sequence[str] = (),
    *,
    renamed: dict[int, str] | None = None,
    special: Sequence[str] = QWEN_SPECIAL,
    named: dict[str, str] | None = None,
    phrases: Sequence[str] = (),
    image: str = QWEN_IMAGE,
) -> dict[str, int]:
    """Write a byte-level tokenizer and its chat template; returns the ids of the tokens added to the vocabulary.

    Args:
        folder: where to.
        vocabulary: words and their ids; the 256 bytes if None.
        merges: how words are put together.
        renamed: ids of the vocabulary that `tokenizer_config.json` calls something else.
        special: the special tokens, which follow the vocabulary.
        named: special tokens that the processor asks for by name.
        phrases: texts that are one token each, after the special ones.
        image: what the chat template writes for a picture.
    """
    folder.mkdir(parents=True, exist_ok=True)
    vocabulary = vocabulary or byte_vocabulary()
    following = {len(vocabulary) + k: name for k, name in enumerate([*special, *phrases])}
    flags = {"lstrip": False, "normalized": False, "rstrip": False, "single_word": False}
    config: dict[str, Any] = {
        "tokenizer_class": "Qwen2Tokenizer",
        "added_tokens_decoder": {
            str(number): {"content": name, "special": name not in phrases, **flags}
            for number, name in {**(renamed or {}), **following}.items()
        },
        "eos_token": "<|im_end|>",
        "pad_token": "<|endoftext|>",
        "additional_special_tokens": list(special[1:]),
        "extra_special_tokens": named or {},
        "model_max_length": 32768,
    }
    if named is None:
        del config["extra_special_tokens"]
    (folder / "vocab.json").write_text(json.dumps(vocabulary, ensure_ascii=False), "utf-8")
    (folder / "merges.txt").write_text("\n".join(["#version: 0.2", *merges]) + "\n", "utf-8")
    (folder / "tokenizer_config.json").write_text(json.dumps(config), "utf-8")
    (folder / "chat_template.jinja").write_text(_CHATML.replace("IMAGE", image), "utf-8")
    return {name: number for number, name in following.items()}


def write_clip_tokenizer(folder: Path, length: int) -> None:
    """Write CLIP's kind of tokenizer, for texts of at most `length` tokens."""
    t: Any = require("transformers", extra="local")
    characters = list(byte_vocabulary())
    words = [*characters, *(f"{c}</w>" for c in characters), "<|startoftext|>", "<|endoftext|>"]
    t.CLIPTokenizer(
        vocab={word: k for k, word in enumerate(words)}, merges=[], model_max_length=length
    ).save_pretrained(folder)


def write_bert_tokenizer(folder: Path) -> None:
    """Write BERT's kind of tokenizer."""
    t: Any = require("transformers", extra="local")
    letters = "abcdefghijklmnopqrstuvwxyz"
    words = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", ".", *letters, *(f"##{c}" for c in letters)]
    t.BertTokenizer(vocab={word: k for k, word in enumerate(words)}).save_pretrained(folder)
