"""Finding checkpoints: what is wrong with a folder or the hub is said at once, and how to put it right."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from a4agent.errors import ModelFilesError
from a4agent.experts import hub
from a4agent.experts.local.checkpoints import find_checkpoint, find_file, parameter_count

HEADER = {"a": {"dtype": "F32", "shape": [3, 5], "data_offsets": [0, 60]}, "__metadata__": {"format": "pt"}}


def write_checkpoint(folder: Path, kind: str = "sam2") -> Path:
    folder.mkdir(parents=True)
    header = json.dumps(HEADER).encode()
    (folder / "model.safetensors").write_bytes(len(header).to_bytes(8, "little") + header + bytes(60))
    (folder / "config.json").write_text(json.dumps({"model_type": kind}))
    return folder


def test_a_folder_is_taken_as_it_is(tmp_path):
    folder = write_checkpoint(tmp_path / "sam")
    found = find_checkpoint(str(folder), kinds=("sam2",))
    assert (found.folder, found.kind) == (folder, "sam2")
    assert parameter_count(folder) == 15


def test_the_digest_of_a_folder_follows_its_weights_and_settings_and_not_its_place(tmp_path):
    first = find_checkpoint(str(write_checkpoint(tmp_path / "a")))
    second = find_checkpoint(str(write_checkpoint(tmp_path / "b")))
    assert first.revision == second.revision
    weights = tmp_path / "b" / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1] + b"\x01")
    third = find_checkpoint(str(tmp_path / "b"))
    assert third.revision != second.revision
    (tmp_path / "b" / "config.json").write_text(json.dumps({"model_type": "sam2", "x": 1}))
    fourth = find_checkpoint(str(tmp_path / "b"))
    assert fourth.revision != third.revision
    (tmp_path / "b" / "chat_template.jinja").write_text("{{ messages }}")
    assert find_checkpoint(str(tmp_path / "b")).revision != fourth.revision
    vocabulary = json.dumps({f"word{k}": k for k in range(50_000)})
    for found in (vocabulary, vocabulary.replace("word7777", "word777x")):
        (tmp_path / "b" / "vocab.json").write_text(found)
        fourth, fifth = find_checkpoint(str(tmp_path / "b")), fourth
    assert fourth.revision != fifth.revision


def test_a_folder_named_like_a_file_is_not_in_the_digest(tmp_path):
    folder = write_checkpoint(tmp_path / "a")
    revision = find_checkpoint(str(folder)).revision
    (folder / "old.model").mkdir()
    assert find_checkpoint(str(folder)).revision == revision


def test_a_repository_without_weights_is_not_fetched_for_ever(tmp_path, monkeypatch):
    folder = write_checkpoint(tmp_path / "0123456789")
    (folder / "model.safetensors").rename(folder / "model.gguf")
    monkeypatch.setattr(hub, "cached", lambda *_: None)
    monkeypatch.setattr(hub, "fetch", lambda *_: folder)
    with pytest.raises(ModelFilesError, match=r"no \.safetensors files, in .*choose another model"):
        find_checkpoint("somebody/gguf")


def test_another_architecture_is_named(tmp_path):
    folder = write_checkpoint(tmp_path / "qwen", "qwen2_5_vl")
    with pytest.raises(ModelFilesError, match=r"is a checkpoint of 'qwen2_5_vl'; 'sam2' or 'sam2_video' is needed"):
        find_checkpoint(str(folder), kinds=("sam2", "sam2_video"))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: (f / "config.json").unlink(), "is not a checkpoint: there is no config.json"),
        (lambda f: (f / "config.json").write_text("{"), "config.json in .* is damaged"),
        (lambda f: (f / "config.json").write_text("[]"), "has no 'model_type'"),
        (lambda f: (f / "model.safetensors").unlink(), "not complete: there are no .safetensors files"),
        (
            lambda f: (f / "model.safetensors.index.json").write_text(
                json.dumps({"weight_map": {"a": "model.safetensors", "b": "model-2.safetensors"}})
            ),
            "not complete: model-2.safetensors: missing, in .*fetch its files again",
        ),
    ],
)
def test_a_damaged_folder_says_what_is_wrong(tmp_path, damage, message):
    folder = write_checkpoint(tmp_path / "sam")
    damage(folder)
    with pytest.raises(ModelFilesError, match=message):
        find_checkpoint(str(folder))


def test_truncated_weights_are_found(tmp_path):
    folder = write_checkpoint(tmp_path / "sam")
    (folder / "model.safetensors").write_bytes((100).to_bytes(8, "little") + b'{"a": ')
    with pytest.raises(ModelFilesError, match="damaged or not complete"):
        parameter_count(folder)


@pytest.mark.parametrize("model", ["./nowhere", "nowhere", "/nowhere/at/all", "a/b/c", "~nobody/x/y"])
def test_a_folder_that_is_not_there(model):
    with pytest.raises(ModelFilesError, match="there is no folder"):
        find_checkpoint(model)


def test_a_file_is_not_a_folder(tmp_path):
    file = tmp_path / "weights.safetensors"
    file.touch()
    with pytest.raises(ModelFilesError, match="give the folder"):
        find_checkpoint(str(file))
    assert find_file(str(file)) == file
    with pytest.raises(ModelFilesError, match="there is no file"):
        find_file(str(tmp_path / "other.safetensors"))


def test_offline_the_error_names_the_variable_and_the_command():
    pytest.importorskip("huggingface_hub")
    with pytest.raises(ModelFilesError, match=r"HF_HUB_OFFLINE forbids.*`a4 models pull facebook/nowhere`"):
        find_checkpoint("facebook/nowhere")


def test_a_name_is_taken_from_the_cache_without_a_network(tmp_path, monkeypatch):
    constants = pytest.importorskip("huggingface_hub.constants")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    repository = tmp_path / "models--somebody--sam"
    commit = "0123456789abcdef0123456789abcdef01234567"
    write_checkpoint(repository / "snapshots" / commit)
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text(commit)
    assert find_checkpoint("somebody/sam").revision == commit
    assert find_checkpoint("somebody/sam", revision=commit).folder.name == commit


class Hub(BaseHTTPRequestHandler):
    """A hub that knows no model, or shows none to strangers."""

    def do_GET(self):
        code = 403 if "gated" in self.path else 404
        self.send_response(code)
        self.send_header("X-Error-Code", "GatedRepo" if code == 403 else "RepoNotFound")
        self.send_header("Content-Length", "0")
        self.end_headers()

    def do_HEAD(self):
        self.do_GET()

    def log_message(self, *_):
        pass


def ask_hub(endpoint: str, model: str, home: Path) -> str:
    code = (
        "from a4agent.experts.local.checkpoints import find_checkpoint\n"
        f"try: find_checkpoint({model!r})\n"
        "except Exception as error: print(type(error).__name__, error)"
    )
    environment = {**os.environ, "HF_ENDPOINT": endpoint, "HF_HUB_OFFLINE": "0", "HF_HOME": str(home)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60)
    return done.stdout + done.stderr


def test_a_hub_that_cannot_be_reached_is_an_error_at_once(tmp_path):
    pytest.importorskip("huggingface_hub")
    said = ask_hub("http://127.0.0.1:9", "facebook/sam2.1-hiera-tiny", tmp_path)
    assert said.startswith("ModelFilesError 'facebook/sam2.1-hiera-tiny' is not on this machine, and the hub could not")
    assert "`a4 models pull facebook/sam2.1-hiera-tiny`" in said
    assert "HF_HUB_OFFLINE" in said


def test_the_hubs_refusals_are_told_apart(tmp_path):
    pytest.importorskip("huggingface_hub")
    server = ThreadingHTTPServer(("127.0.0.1", 0), Hub)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    endpoint = f"http://127.0.0.1:{server.server_port}"
    try:
        assert ask_hub(endpoint, "somebody/gated", tmp_path).startswith("CredentialError 'somebody/gated' is gated")
        assert ask_hub(endpoint, "somebody/nothing", tmp_path).startswith("ModelFilesError there is neither a folder")
    finally:
        server.shutdown()
        server.server_close()
