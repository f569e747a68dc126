"""Damage to checkpoints is found, and nothing else is taken for damage."""

from __future__ import annotations

import hashlib
import json

import pytest

from a4agent.experts.checkpoint_files import damage_in
from fake_hub import safetensors

WEIGHTS = safetensors(100)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "config.json").write_text('{"model_type": "sam2"}')
    (tmp_path / "model.safetensors").write_bytes(WEIGHTS)
    return tmp_path


def test_a_whole_checkpoint_has_no_damage(folder):
    read = []
    assert damage_in(folder, on_file=read.append) == []
    assert len(read) == 2
    assert damage_in(folder / "model.safetensors") == []


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (WEIGHTS[:-8], "lacks 8 bytes"),
        (WEIGHTS + b"xx", "2 bytes too many"),
        (WEIGHTS[:4], "cut off"),
        (b"", "cut off"),
        (WEIGHTS[:8] + b"x" * (len(WEIGHTS) - 8), "damaged"),
        (b"\xff" * 100, "cut off"),
        ((2).to_bytes(8, "little") + b"[]", "damaged"),
    ],
)
def test_a_file_of_weights_that_is_not_whole(folder, data, words):
    (folder / "model.safetensors").write_bytes(data)
    (problem,) = damage_in(folder)
    assert problem.startswith("model.safetensors: ")
    assert words in problem


def test_shards_that_the_index_names_are_needed(folder):
    index = {"weight_map": {"a": "model.safetensors", "b": "model-2.safetensors"}}
    (folder / "model.safetensors.index.json").write_text(json.dumps(index))
    assert damage_in(folder) == ["model-2.safetensors: missing"]


@pytest.mark.parametrize("text", ["{", "[]", "{}"])
def test_an_index_without_a_weight_map_is_damaged(folder, text):
    (folder / "model.safetensors.index.json").write_text(text)
    assert "model.safetensors.index.json" in damage_in(folder)[0]


def test_a_folder_without_a_config_is_not_a_checkpoint(tmp_path):
    assert "not a checkpoint" in damage_in(tmp_path)[0]


def test_missing_weights_are_reported(folder):
    (folder / "model.safetensors").unlink()
    assert damage_in(folder) == ["there are no .safetensors files"]


def test_the_parts_of_a_pipeline_are_needed(tmp_path):
    index = {
        "_class_name": "P",
        "vae": ["d", "V"],
        "text_encoder": ["t", "T"],
        "tokenizer": ["t", "K"],
        "x": [None, None],
    }
    (tmp_path / "model_index.json").write_text(json.dumps(index))
    for part in ("vae", "tokenizer"):
        (tmp_path / part).mkdir()
    (tmp_path / "vae" / "config.json").write_text("{}")
    (tmp_path / "other.safetensors").write_bytes(WEIGHTS)
    assert damage_in(tmp_path) == ["text_encoder: missing", "vae: no weights"]


def test_contents_are_compared_with_the_name_the_cache_gave_them(tmp_path):
    blobs, snapshot = tmp_path / "blobs", tmp_path / "snapshots" / "c"
    blobs.mkdir()
    snapshot.mkdir(parents=True)
    config = b'{"model_type": "sam2"}'
    small = blobs / hashlib.sha1(f"blob {len(config)}\0".encode() + config).hexdigest()
    large = blobs / hashlib.sha256(WEIGHTS).hexdigest()
    small.write_bytes(config)
    large.write_bytes(WEIGHTS)
    (snapshot / "config.json").symlink_to(small)
    (snapshot / "model.safetensors").symlink_to(large)
    assert damage_in(snapshot) == []
    small.write_bytes(config.replace(b"2", b"3"))
    large.write_bytes(WEIGHTS[:-1] + b"\x01")
    assert len(damage_in(snapshot)) == 2
    assert damage_in(snapshot, contents=False) == []


def test_a_dangling_link_is_not_a_file(folder):
    (folder / "model.safetensors").unlink()
    (folder / "model.safetensors").symlink_to(folder / "gone")
    assert damage_in(folder) == ["there are no .safetensors files"]
