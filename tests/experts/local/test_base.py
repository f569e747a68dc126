"""Placement, memory and loading: what every local expert does before it can answer."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from a4agent.errors import (
    ConfigError,
    MissingExtraError,
    ModelFilesError,
    OutOfMemory,
    ProviderError,
    ResourceError,
    UnknownNameError,
)
from a4agent.experts.local import base as local_models
from a4agent.experts.local import sam2
from a4agent.experts.local.base import QUANTISE, LocalExpert, Placement, load_pretrained, place
from a4agent.experts.local.checkpoints import find_checkpoint

torch = pytest.importorskip("torch")

MODULES = sorted(path.stem for path in Path(local_models.__file__).parent.glob("*.py"))


def test_importing_the_experts_imports_no_framework():
    code = (
        f"import sys\nfrom a4agent.experts.local import {', '.join(MODULES)}\n"
        "print([m for m in ('torch', 'transformers', 'diffusers', 'huggingface_hub', 'scipy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


class Counter(LocalExpert):
    """Answers with the number of requests in the batch; more than `fits` of them do not fit."""

    shrinking = (QUANTISE,)

    def __init__(self, checkpoint, fits=8, error=None, quantisation="none", **options):
        placement = Placement("cpu", "float32", quantisation=quantisation)
        super().__init__("test:counter", checkpoint, placement, settings={}, **options)
        self.fits, self.error, self.batches = fits, error, []

    def _load(self):
        pass

    def _unload(self):
        pass

    def answer(self, requests, **options):
        return self._in_batches(requests, self._run, **options)

    def _run(self, batch):
        self.batches.append(list(batch))
        if len(batch) > self.fits:
            raise self.error or torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 3 GiB")
        return [f"{request} of {len(batch)}" for request in batch]


@pytest.fixture
def checkpoint(tiny_sam2):
    return find_checkpoint(str(tiny_sam2))


@pytest.mark.parametrize(
    "error",
    [
        torch.OutOfMemoryError("CUDA out of memory."),
        RuntimeError("MPS backend out of memory (MPS allocated: 9 GB)"),
        RuntimeError("[enforce fail at alloc_cpu.cpp:117] DefaultCPUAllocator: can't allocate memory: 9 bytes"),
        MemoryError(),
    ],
)
def test_out_of_memory_halves_the_batch_and_later_ones_stay_small(checkpoint, error):
    expert = Counter(checkpoint, fits=2, error=error, max_batch=8)
    assert [str(a)[0] for a in expert.answer("abcdefghi")] == list("abcdefghi")
    assert [len(batch) for batch in expert.batches] == [8, 4, 2, 2, 2, 2, 1]
    expert.batches.clear()
    expert.answer("abcd")
    assert [len(batch) for batch in expert.batches] == [2, 2]
    assert expert.max_batch == 8


def test_one_request_that_does_not_fit_spoils_no_other(checkpoint):
    expert = Counter(checkpoint, fits=0, max_batch=4)
    answers = expert.answer("abc")
    assert [type(answer) for answer in answers] == [OutOfMemory] * 3
    assert "4bit" in str(answers[0])
    assert "Tried to allocate 3 GiB" in str(answers[0])
    expert.fits = 1
    assert expert.answer("abc") == ["a of 1", "b of 1", "c of 1"]


@pytest.mark.parametrize(("quantisation", "advised"), [("none", True), ("8bit", True), ("4bit", False)])
def test_what_is_in_use_already_is_not_advised(checkpoint, monkeypatch, quantisation, advised):
    expert = Counter(checkpoint, fits=0, quantisation=quantisation)
    assert ("quantisation = '4bit'" in str(expert.answer("a")[0])) is advised
    monkeypatch.setattr(local_models, "free_bytes", lambda device: 0)
    with pytest.raises(ResourceError) as told:
        local_models.check_fits(checkpoint.folder, expert.placement, shrinking=expert.shrinking)
    assert ("quantisation = '4bit'" in str(told.value)) is advised


def test_requests_that_differ_share_no_batch_and_keep_their_order(checkpoint):
    expert = Counter(checkpoint, max_batch=2)
    assert expert.answer([3, 10, 4, 5, 11], alike=lambda number: number > 9) == [
        *("3 of 2", "10 of 2", "4 of 2", "5 of 1", "11 of 2")
    ]


def test_another_failure_is_the_models(checkpoint):
    expert = Counter(checkpoint, fits=0, error=ValueError("shapes"))
    with pytest.raises(ProviderError, match="test:counter failed: ValueError: shapes"):
        expert.answer("a")


def test_weights_that_do_not_fit_say_what_they_need_and_what_is_free(tiny_sam2, noise, monkeypatch):
    monkeypatch.setattr(local_models, "free_bytes", lambda device: 1000)
    segmenter = sam2.create(str(tiny_sam2), "segmenter")
    wanted = r"need 0\.0 GB as float32 and 0\.0 GB are free on 'cpu': choose a smaller model or another device"
    with pytest.raises(ResourceError, match=wanted):
        segmenter.load()
    monkeypatch.setattr(local_models, "free_bytes", lambda device: 10**9)
    segmenter.load()


def test_only_settings_that_an_expert_has_are_advised(tiny_qwen_vl, monkeypatch):
    from a4agent.experts.local import transformers_vlm

    monkeypatch.setattr(local_models, "free_bytes", lambda device: 1000)
    with pytest.raises(ResourceError, match="a smaller model, quantisation = '4bit' or another device"):
        transformers_vlm.create(str(tiny_qwen_vl), "vlm").load()


def test_the_need_counts_parameters_and_bytes(checkpoint, monkeypatch):
    seen = []
    count = sum(p.numel() for p in load_pretrained_sam2(checkpoint).state_dict().values())
    monkeypatch.setattr(local_models, "parameter_count", lambda folder: count * 10**4)
    monkeypatch.setattr(local_models, "free_bytes", lambda device: seen.append(device) or 0)
    for dtype, quantisation, each in (("float32", "none", 4), ("bfloat16", "none", 2), ("bfloat16", "4bit", 0.6)):
        with pytest.raises(ResourceError, match=f"need {count * each / 1e5:.1f} GB"):
            local_models.check_fits(checkpoint.folder, Placement("cpu", dtype, quantisation=quantisation))
    assert seen == ["cpu"] * 3


def load_pretrained_sam2(checkpoint):
    from transformers import Sam2Model

    return load_pretrained(Sam2Model, checkpoint, Placement("cpu", "float32"))


def test_free_memory_is_that_of_the_machine():
    import psutil

    assert 0 < local_models.free_bytes("cpu") <= psutil.virtual_memory().total


def test_weights_that_are_not_in_the_files_are_never_invented_in_silence(tiny_sam2, tmp_path):
    from safetensors.torch import load_file, save_file

    weights = load_file(tiny_sam2 / "model.safetensors")
    (tmp_path / "config.json").write_bytes((tiny_sam2 / "config.json").read_bytes())
    names = sorted(weights)

    def keep(count):
        save_file({name: weights[name] for name in names[:count]}, tmp_path / "model.safetensors", {"format": "pt"})
        return load_pretrained_sam2(find_checkpoint(str(tmp_path)))

    with pytest.warns(UserWarning, match="lacks 2 of .* they are random now"):
        keep(len(names) - 2)
    with pytest.raises(ModelFilesError, match="not complete, or of another architecture"):
        keep(len(names) // 2)


def test_damaged_weights_are_a_files_error(tiny_sam2, tmp_path):
    for file in tiny_sam2.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    weights = tmp_path / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-5000])
    with pytest.raises(ModelFilesError, match="cannot be loaded as Sam2Model"):
        load_pretrained_sam2(find_checkpoint(str(tmp_path)))
    config = json.loads((tmp_path / "config.json").read_text())
    config["vision_config"]["fpn_hidden_size"] = 64
    (tmp_path / "config.json").write_text(json.dumps(config))
    weights.write_bytes((tiny_sam2 / "model.safetensors").read_bytes())
    with pytest.raises(ModelFilesError, match="cannot be loaded as Sam2Model"):
        load_pretrained_sam2(find_checkpoint(str(tmp_path)))


def test_placement():
    assert place("cpu") == Placement("cpu", "float32")
    assert place("cpu", "bfloat16").torch_dtype is torch.bfloat16
    with pytest.raises(UnknownNameError, match="dtype 'float31'; did you mean 'float32'"):
        place("cpu", "float31")
    with pytest.raises(UnknownNameError, match="quantisation '4-bit'; did you mean '4bit'"):
        place("cpu", quantisation="4-bit")
    if not torch.cuda.is_available():
        with pytest.raises(ConfigError, match=r"device 'cuda' cannot be used here .*sees 'cpu'"):
            place("cuda")


def test_quantisation_names_what_it_needs(monkeypatch):
    monkeypatch.setitem(sys.modules, "bitsandbytes", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'a4agent\[quantisation\]'"):
        place("cpu", quantisation="4bit")


def test_attention_that_is_not_installed_is_a_setting_to_change(tiny_qwen_vl):
    from a4agent.experts.local import transformers_vlm

    expert = transformers_vlm.create(str(tiny_qwen_vl), "vlm", attention="flash_attention_2")
    with pytest.raises((ConfigError, ModelFilesError), match=r"flash"):
        expert.load()


def test_attention_that_nobody_knows_is_a_setting_to_change(tiny_qwen_vl):
    from a4agent.experts.local import transformers_vlm

    with pytest.raises(ConfigError, match="attention 'fast' cannot be used"):
        transformers_vlm.create(str(tiny_qwen_vl), "vlm", attention="fast").load()
