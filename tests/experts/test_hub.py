"""The hub without a network: what is said when it cannot be asked. (With one: tests/cli/test_models.py.)"""

from __future__ import annotations

import errno
import sys

import pytest

from a4agent.errors import MissingExtraError, ModelFilesError, ResourceError
from a4agent.experts import hub
from fake_hub import COMMIT, safetensors

NAME = "owner/model-that-nobody-has"


@pytest.fixture
def online(monkeypatch):
    """Let the hub be asked; what answers is up to the test."""
    constants = pytest.importorskip("huggingface_hub").constants
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    return monkeypatch


def test_what_is_not_cached_is_none():
    pytest.importorskip("huggingface_hub")
    assert hub.cached(NAME) is None
    assert hub.cached(NAME, file="a/b.safetensors") is None


@pytest.mark.parametrize("file", ["", "a.safetensors"])
def test_a_name_that_no_repository_can_have_is_told(file):
    pytest.importorskip("huggingface_hub")
    with pytest.raises(ModelFilesError, match=r"'owner/a\.\.b' is not a model name: "):
        hub.cached("owner/a..b", file=file)


@pytest.mark.parametrize("ask", [hub.reach, hub.fetch, hub.download_bytes])
def test_offline_nothing_is_asked(ask):
    pytest.importorskip("huggingface_hub")
    with pytest.raises(ModelFilesError, match=f"HF_HUB_OFFLINE.*a4 models pull {NAME}"):
        ask(NAME)


def test_without_its_client_nothing_is_cached_and_asking_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    assert hub.cached(NAME) is None
    with pytest.raises(MissingExtraError, match=r"pip install 'a4agent\[local\]'"):
        hub.reach(NAME)


def test_a_full_disk_is_not_called_a_hub_that_cannot_be_reached(online):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    online.setattr(hub, "reach", lambda *_: None)
    online.setattr("huggingface_hub.snapshot_download", full)
    with pytest.raises(ResourceError, match="HF_HOME"):
        hub.fetch(NAME)


def test_a_cache_that_cannot_be_written_to_is_not_a_hub_that_cannot_be_reached(online):
    def closed(*_, **__):
        raise PermissionError(errno.EACCES, "Permission denied", "/models")

    online.setattr(hub, "reach", lambda *_: None)
    online.setattr("huggingface_hub.snapshot_download", closed)
    with pytest.raises(ResourceError, match=r"cannot be written to .*Permission denied.*HF_HOME"):
        hub.fetch(NAME)


def test_a_snapshot_that_another_program_began_is_not_taken_for_a_whole_one(tmp_path, monkeypatch):
    constants = pytest.importorskip("huggingface_hub").constants
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    folder = tmp_path / f"models--{NAME.replace('/', '--')}"
    snapshot = folder / "snapshots" / COMMIT
    snapshot.mkdir(parents=True)
    (folder / "refs").mkdir()
    (folder / "refs" / "main").write_text(COMMIT)
    (snapshot / "config.json").write_text('{"model_type": "sam2"}')
    assert hub.cached(NAME) is None
    (snapshot / "model.safetensors").write_bytes(safetensors())
    assert hub.cached(NAME) == snapshot


@pytest.mark.parametrize(
    ("wanted", "reference"),
    [((NAME,), NAME), ((NAME, "v2"), f"{NAME}@v2"), ((NAME, None, "a/b.safetensors"), f"{NAME}/a/b.safetensors")],
)
def test_the_command_that_is_named_fetches_what_was_wanted(wanted, reference):
    pytest.importorskip("huggingface_hub")
    with pytest.raises(ModelFilesError, match=f"`a4 models pull {reference}`"):
        hub.reach(*wanted)


def test_whatever_else_goes_wrong_names_the_model_and_the_command(online):
    tried = []

    def odd(*_, **__):
        tried.append(1)
        raise RuntimeError("something odd\nand long")

    online.setattr(hub, "reach", lambda *_: None)
    online.setattr(hub, "_PAUSE_SECONDS", 0.0)
    online.setattr("huggingface_hub.snapshot_download", odd)
    with pytest.raises(ModelFilesError, match=f"{NAME}.*something odd.*a4 models pull {NAME}") as failed:
        hub.fetch(NAME)
    assert "and long" not in str(failed.value)
    assert len(tried) == 3


def test_a_download_that_broke_off_is_taken_up_again(online, tmp_path):
    results = [ConnectionError("peer closed connection"), str(tmp_path)]

    def flaky(*_, **__):
        result = results.pop(0)
        if isinstance(result, Exception):
            raise result
        return result

    online.setattr(hub, "reach", lambda *_: None)
    online.setattr(hub, "_PAUSE_SECONDS", 0.0)
    online.setattr("huggingface_hub.snapshot_download", flaky)
    assert hub.fetch(NAME) == tmp_path
