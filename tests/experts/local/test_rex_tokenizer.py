"""The tokenizer trap: files as published give coordinates other ids, and the repair puts them back."""

from __future__ import annotations

import json

import pytest

from a4agent.errors import ModelFilesError
from a4agent.experts import rex_omni_answer
from a4agent.experts.local.rex_tokenizer import load_repaired_processor, repaired_files, wrong_ids

pytest.importorskip("torch")

ANSWER = "<|object_ref_start|>cup<|object_ref_end|><|box_start|><1><2><3><999><|box_end|>"


def load(folder):
    from transformers import AutoTokenizer

    return AutoTokenizer.from_pretrained(folder)


def test_the_published_files_fall_into_the_trap_and_are_repaired(tiny_rex_omni):
    before = {file.name: file.read_bytes() for file in tiny_rex_omni.iterdir()}
    wrong = wrong_ids(load(tiny_rex_omni))
    assert wrong["<0>"][1] == 150643
    assert "<|box_start|>" in wrong
    tokenizer = load_repaired_processor(tiny_rex_omni).tokenizer
    assert wrong_ids(tokenizer) == {}
    ids = tokenizer(ANSWER)["input_ids"]
    assert ids[4:] == [151647, 151648, 150644, 150645, 150646, 151642, 151649]
    assert tokenizer.decode(ids) == ANSWER
    assert {file.name: file.read_bytes() for file in tiny_rex_omni.iterdir()} == before


def test_a_repaired_folder_needs_no_repair_and_keeps_other_words(tiny_rex_omni, tmp_path):
    repaired = repaired_files(tiny_rex_omni, tmp_path / "repaired")
    assert wrong_ids(load(repaired)) == {}
    published, ours = (json.loads((folder / "vocab.json").read_text("utf-8")) for folder in (tiny_rex_omni, repaired))
    changed = {number for word, number in published.items() if ours.get(word) != number}
    assert changed == set(range(150643, 151643))
    assert not (repaired / "model.safetensors").exists()
    merges = (repaired / "merges.txt").read_text("utf-8").split("\n")
    assert merges == ["#version: 0.2", ""]  # all merges of the tiny vocabulary led to renamed words


def test_a_vocabulary_kept_in_one_file_is_repaired_too(tiny_rex_omni, tmp_path):
    """Without vocab.json the words come from tokenizer.json."""
    vocabulary = json.loads((tiny_rex_omni / "vocab.json").read_text("utf-8"))
    merges = (tiny_rex_omni / "merges.txt").read_text("utf-8").split("\n")[1:-1]
    for name in ("tokenizer_config.json", "config.json"):
        (tmp_path / name).write_bytes((tiny_rex_omni / name).read_bytes())
    model = {"type": "BPE", "vocab": vocabulary, "merges": [merge.split(" ") for merge in merges]}
    (tmp_path / "tokenizer.json").write_text(json.dumps({"model": model}), "utf-8")
    assert wrong_ids(load(repaired_files(tmp_path, tmp_path / "repaired"))) == {}


def test_another_models_tokenizer_is_refused(tiny_qwen_vl):
    with pytest.raises(ModelFilesError, match=r"is not Rex-Omni's: '<0>' has the id .* and not 150643"):
        load_repaired_processor(tiny_qwen_vl)


def test_a_tokenizer_that_cannot_be_read(tmp_path):
    with pytest.raises(ModelFilesError, match="cannot be read"):
        repaired_files(tmp_path, tmp_path / "repaired")


def test_the_reader_knows_the_same_ids(tiny_rex_omni):
    tokenizer = load_repaired_processor(tiny_rex_omni).tokenizer
    shapes = rex_omni_answer.read_tokens(tokenizer(ANSWER)["input_ids"], (999, 999), tokenizer.decode)
    assert shapes == [("cup", "box", [1.0, 2.0, 3.0, 999.0])]
