"""Rex-Omni's tokenizer, repaired: its coordinate tokens at the ids that the model was trained with.

The published files say that ids 150643..151642 are `<0>`..`<999>` in `tokenizer_config.json` only; `vocab.json`
still holds the words that these ids were before. Slow tokenizers obeyed the former. Fast ones, the only kind in
transformers 5, give `<0>`..`<999>` new ids instead, the special tokens move, and answers decode to garbage.
The repair renames the words in `vocab.json` and drops the merges that lead to them.

    repaired_files(folder, into)     # also what a vLLM server needs: `vllm serve ... --tokenizer INTO`
"""

from __future__ import annotations

import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

from a4agent.errors import ModelFilesError
from a4agent.experts.local.generation import load_processor
from a4agent.experts.rex_omni_answer import FIRST_COORDINATE_ID, SPECIAL_IDS

EXPECTED_IDS = {"<0>": FIRST_COORDINATE_ID, "<999>": FIRST_COORDINATE_ID + 999, **SPECIAL_IDS}
_COPIED = ("*.json", "*.jinja", "*.txt")
_LEFT_OUT = ("tokenizer.json", "vocab.json", "merges.txt", "added_tokens.json", "model.safetensors.index.json")


def load_repaired_processor(folder: Path) -> Any:
    """The processor of a Rex-Omni checkpoint, with a tokenizer whose ids have been checked.

    The folder is left as it is: a repair happens in a temporary copy.

    Raises:
        ModelFilesError: files are missing, or the ids are wrong even after the repair.
    """
    processor = load_processor(folder)
    if not wrong_ids(processor.tokenizer):
        return processor
    with tempfile.TemporaryDirectory(prefix="a4-rex-tokenizer-") as name:
        repaired_files(folder, Path(name))
        processor = load_processor(Path(name))
    wrong = wrong_ids(processor.tokenizer)
    if wrong:
        token, (found, expected) = next(iter(wrong.items()))
        raise ModelFilesError(
            f"the tokenizer in {str(folder)!r} is not Rex-Omni's: {token!r} has the id {found} and not {expected} "
            f"({len(wrong)} such tokens), so its answers could not be read"
        )
    return processor


def wrong_ids(tokenizer: Any) -> dict[str, tuple[Any, int]]:
    """The tokens whose ids are not those of the published model: (found, expected)."""
    found = {token: tokenizer.convert_tokens_to_ids(token) for token in EXPECTED_IDS}
    return {token: (found[token], number) for token, number in EXPECTED_IDS.items() if found[token] != number}


def repaired_files(folder: Path, into: Path) -> Path:
    """Write the tokenizer and processor files of `folder` to `into`, repaired.

    Raises:
        ModelFilesError: the vocabulary cannot be read.
    """
    into.mkdir(parents=True, exist_ok=True)
    for pattern in _COPIED:
        for file in folder.glob(pattern):
            if file.name not in _LEFT_OUT:
                shutil.copyfile(file, into / file.name)
    try:
        vocabulary, merges = _vocabulary_and_merges(folder)
        config = json.loads((folder / "tokenizer_config.json").read_text("utf-8"))
        meant = {int(number): token["content"] for number, token in config.get("added_tokens_decoder", {}).items()}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ModelFilesError(f"the tokenizer in {str(folder)!r} cannot be read: {error!r}") from error
    words = {number: word for word, number in vocabulary.items()}
    renamed = {words[number]: token for number, token in meant.items() if words.get(number, token) != token}
    vocabulary = {renamed.get(word, word): number for word, number in vocabulary.items()}
    kept = [(left, right) for left, right in merges if renamed.keys().isdisjoint((left, right, left + right))]
    lines = ["#version: 0.2", *(f"{left} {right}" for left, right in kept)]
    (into / "vocab.json").write_text(json.dumps(vocabulary, ensure_ascii=False), "utf-8")
    (into / "merges.txt").write_text("\n".join(lines) + "\n", "utf-8")
    return into


def _vocabulary_and_merges(folder: Path) -> tuple[dict[str, int], list[tuple[str, str]]]:
    if (folder / "vocab.json").is_file():
        vocabulary = json.loads((folder / "vocab.json").read_text("utf-8"))
        lines = (folder / "merges.txt").read_text("utf-8").split("\n")
        pairs = [line.split(" ") for line in lines if line and not line.startswith("#version")]
    else:
        model = json.loads((folder / "tokenizer.json").read_text("utf-8"))["model"]
        vocabulary = model["vocab"]
        pairs = [merge.split(" ") if isinstance(merge, str) else merge for merge in model["merges"]]
    return vocabulary, [(left, right) for left, right in pairs]
