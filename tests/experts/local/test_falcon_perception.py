"""Falcon Perception: a stand-in with the published repository's layout, configuration and way to be called."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from a4agent.errors import ConfigError, ModelFilesError, ProviderError
from a4agent.experts import registry
from a4agent.experts.local import falcon_perception
from a4agent.experts.local.checkpoints import digest_of
from a4agent.experts.local.falcon_perception import read_instances
from a4agent.imaging.masks import encode_rle
from a4agent.protocols import DetectRequest
from a4agent.stages.recorder import Recorder
from a4agent.stages.spotter import Spotter

torch = pytest.importorskip("torch")
transformers = pytest.importorskip("transformers")

CONFIG = {
    "architectures": ["FalconPerceptionForSegmentation"],
    "auto_map": {
        "AutoConfig": "configuration_falcon_perception.FalconPerceptionConfig",
        "AutoModelForCausalLM": "modeling_falcon_perception.FalconPerceptionForSegmentation",
    },
    "model_type": "falcon_perception",
    "torch_dtype": "float32",
    "dim": 4,
    "spatial_patch_size": 16,
}
CONFIGURATION = """
from transformers import PretrainedConfig

class FalconPerceptionConfig(PretrainedConfig):
    model_type = "falcon_perception"

    def __init__(self, dim=4, spatial_patch_size=16, **kwargs):
        self.dim, self.spatial_patch_size = dim, spatial_patch_size
        super().__init__(**kwargs)
"""
MODELING = """
import numpy as np
import torch
from pycocotools import mask as rle
from transformers import PreTrainedModel

from .configuration_falcon_perception import FalconPerceptionConfig


class FalconPerceptionForSegmentation(PreTrainedModel):
    config_class = FalconPerceptionConfig

    def __init__(self, config):
        super().__init__(config)
        self.tok_embeddings = torch.nn.Embedding(8, config.dim)
        self.register_buffer("freqs_cis", torch.arange(config.dim, dtype=torch.float32) + 1, persistent=False)
        self._weights_fused = True
        self.post_init()

    def _ensure_device_buffers(self):
        if not self._weights_fused:
            self.freqs_cis = torch.arange(self.config.dim, dtype=torch.float32, device=self.device) + 1
            self._weights_fused = True

    def generate(self, images, queries, max_new_tokens=2048, min_dimension=256, max_dimension=1024, compile=True,
                 segm_threshold=0.3):
        assert len(images) == len(queries) and compile is False and max_dimension == 512
        assert self.freqs_cis.tolist() == [1, 2, 3, 4], "the rotations were not filled in"
        return [self._instances(image, query) for image, query in zip(images, queries)]

    def _instances(self, image, query):
        found = []
        for place in range(query.count("handle")):
            mask = np.zeros((image.height, image.width), np.uint8, order="F")
            mask[2:6, 10 * place : 10 * place + 5] = 1
            coded = rle.encode(mask)
            x, y, w, h = rle.toBbox(coded)
            found.append({
                "xy": {"x": (x + w / 2) / image.width, "y": (y + h / 2) / image.height},
                "hw": {"h": h / image.height, "w": w / image.width},
                "mask_rle": {"size": list(coded["size"]), "counts": coded["counts"].decode()},
            })
        return found
"""


@pytest.fixture
def checkpoint(tmp_path, monkeypatch) -> Path:
    from safetensors.torch import save_file

    monkeypatch.setattr(transformers.dynamic_module_utils, "HF_MODULES_CACHE", str(tmp_path / "modules"))
    folder = tmp_path / "falcon"
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps(CONFIG))
    (folder / "configuration_falcon_perception.py").write_text(CONFIGURATION)
    (folder / "modeling_falcon_perception.py").write_text(MODELING)
    weights = {"tok_embeddings.weight": torch.ones(8, 4)}
    save_file(weights, folder / "model.safetensors", metadata={"format": "pt"})
    return folder


def test_a_phrase_becomes_boxes_and_masks(checkpoint, noise):
    detector = falcon_perception.create(str(checkpoint), "detector", trust_remote_code=True, max_dimension=512)
    one, none, two = detector.detect([DetectRequest(noise(40, 30), p) for p in ("handle", "rim", "handle, handle")])
    np.testing.assert_allclose(one.boxes_xyxy, [[0, 2, 5, 6]], atol=1e-4)
    assert one.masks.sum() == 20
    assert one.masks[0, 2:6, :5].all()
    assert (none.boxes_xyxy.shape, none.masks.shape) == ((0, 4), (0, 30, 40))
    np.testing.assert_allclose(two.boxes_xyxy, [[0, 2, 5, 6], [10, 2, 15, 6]], atol=1e-4)
    assert two.points_xy.shape == (0, 2)
    assert two.scores is None


def test_alone_it_is_a_spotter(checkpoint, noise):
    settings = {"trust_remote_code": True, "max_dimension": 512}
    spotter = Spotter(registry.create(f"falcon-perception:{checkpoint}", "detector", settings), None)
    (region,) = spotter.locate(noise(40, 30), "the handle", Recorder())
    assert region.mask.sum() == 20


def test_code_runs_only_when_it_is_trusted(checkpoint):
    (checkpoint / "modeling_falcon_perception.py").write_text("raise SystemExit('it ran')")
    with pytest.raises(ConfigError, match=r"runs the Python code .*set trust_remote_code = true"):
        registry.create(f"falcon-perception:{checkpoint}", "detector")


def test_other_code_is_another_revision(checkpoint):
    before = digest_of(checkpoint)
    (checkpoint / "modeling_falcon_perception.py").write_text(MODELING.replace("10 * place", "11 * place"))
    assert digest_of(checkpoint) != before


def test_mistakes_are_named(checkpoint, tiny_sam2):
    with pytest.raises(ModelFilesError, match="is a checkpoint of 'sam2'; 'falcon_perception' is needed"):
        falcon_perception.create(str(tiny_sam2), "detector", trust_remote_code=True)
    with pytest.raises(ConfigError, match="max_dimension"):
        falcon_perception.create(str(checkpoint), "detector", trust_remote_code=True, max_dimension=0)
    with pytest.raises(ConfigError, match="cannot be the segmenter"):
        registry.create(f"falcon-perception:{checkpoint}", "segmenter", {"trust_remote_code": True})
    (checkpoint / "modeling_falcon_perception.py").write_text(f"import a_package_that_nobody_has\n{MODELING}")
    detector = falcon_perception.create(str(checkpoint), "detector", trust_remote_code=True)
    with pytest.raises(ConfigError, match=r"needs a package .*a_package_that_nobody_has"):
        detector.load()


def instance(mask: np.ndarray | None) -> dict:
    rle = {} if mask is None else {"mask_rle": dict(encode_rle(mask))}
    return {"xy": {"x": 0.5, "y": 0.25}, "hw": {"h": 0.5, "w": 0.2}, **rle}


def test_a_model_without_masks_gives_boxes_alone():
    boxes, masks = read_instances([instance(None)], (100, 40))
    np.testing.assert_allclose(boxes, [[40, 0, 60, 20]], atol=1e-4)
    assert masks is None


@pytest.mark.parametrize("bad", [instance(np.ones((2, 2), bool)), {"xy": {"x": 0.5}}, {}])
def test_an_instance_that_cannot_be_read_is_an_error_of_that_request(checkpoint, noise, bad):
    detector = falcon_perception.create(str(checkpoint), "detector", trust_remote_code=True, max_dimension=512)
    detector.load()
    detector._model.generate = lambda images, queries, **_: [[bad], []]
    broken, empty = detector.detect([DetectRequest(noise(40, 30), "a"), DetectRequest(noise(40, 30), "b")])
    assert isinstance(broken, ProviderError)
    assert len(empty.boxes_xyxy) == 0
