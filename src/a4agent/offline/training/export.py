"""From a trained network to its file, its scores on drawings that it was not trained on, and its card."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import numpy as np
import torch

from a4agent.errors import require
from a4agent.offline.training import shards
from a4agent.offline.training.network import SIDE, Eye
from a4agent.offline.training.simulator import HELD_OUT
from a4agent.offline.training.train import TrainSettings
from a4agent.offline.vocabulary import KINDS, PARTS

OPSET = 17
Scores = dict[str, float]


def export(network: Eye, path: Path) -> None:
    """Write the network as ONNX, with weights of half precision that are widened when it is loaded."""
    onnx = require("onnx", extra="train")
    buffer = io.BytesIO()
    axes = {"crops": {0: "n", 2: "height", 3: "width"}, "parts": {0: "n", 2: "height", 3: "width"}, "kinds": {0: "n"}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter that needs no further package says that it is the old one
        torch.onnx.export(
            network.eval(),
            (torch.zeros(2, 3, SIDE, SIDE),),
            buffer,  # pyright: ignore[reportArgumentType]
            dynamo=False,
            opset_version=OPSET,
            input_names=["crops"],
            output_names=["parts", "kinds"],
            dynamic_axes=axes,
        )
    model = onnx.load_model_from_string(buffer.getvalue())
    _halve(onnx, model.graph)
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())


def _halve(onnx, graph) -> None:  # pyright: ignore
    """Keep large float32 tensors as float16, each followed by a cast, which the runtime folds away."""
    casts = []
    for tensor in graph.initializer:
        values = onnx.numpy_helper.to_array(tensor)
        if values.dtype != np.float32 or values.size < 64:
            continue
        name = tensor.name
        half = onnx.numpy_helper.from_array(values.astype(np.float16), f"{name}_half")
        tensor.CopyFrom(half)
        casts.append(onnx.helper.make_node("Cast", [f"{name}_half"], [name], to=onnx.TensorProto.FLOAT))
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)


def difference(network: Eye, path: Path, seed: int = 0, n: int = 8) -> float:
    """The largest difference between the probabilities of the network and of the file, on random crops."""
    onnxruntime = require("onnxruntime", extra="offline")
    crops = torch.randn(n, 3, SIDE, SIDE, generator=torch.Generator().manual_seed(seed)).clamp(-1, 1)
    session = onnxruntime.InferenceSession(path.read_bytes(), providers=["CPUExecutionProvider"])
    answers = session.run(["parts", "kinds"], {"crops": crops.numpy()})
    with torch.no_grad():
        expected = network.eval()(crops)
    return max(
        float((torch.from_numpy(answer).softmax(1) - logits.softmax(1)).abs().max())
        for answer, logits in zip(answers, expected, strict=True)
    )


def measure(network: Eye, shard: Path, batch: int = 64) -> Scores:
    """The mean IoU of each part over the drawings that show it, of the whole thing, and the share of right kinds."""
    images, parts, kinds = shards.read(shard)
    edge = (images.shape[1] - SIDE) // 2
    images, parts = (array[:, edge : edge + SIDE, edge : edge + SIDE] for array in (images, parts))
    found, named = [], []
    with torch.no_grad():
        for start in range(0, len(images), batch):
            crops = torch.from_numpy(images[start : start + batch].astype(np.float32) / 127.5 - 1)
            maps, logits = network.eval()(crops.permute(0, 3, 1, 2).contiguous())
            found.append(maps.argmax(1).numpy())
            named.append(logits.argmax(1).numpy())
    answer = np.concatenate(found)
    scores = {"kind": float((np.concatenate(named) == kinds).mean()), "whole": _iou(answer > 0, parts > 0)}
    scores |= {name: _iou(answer == k, parts == k) for k, name in enumerate(PARTS) if k}
    return scores


def _iou(answer: np.ndarray, truth: np.ndarray) -> float:
    """The mean over the drawings (n, h, w) in which there is something to find."""
    shown = truth.any((1, 2))
    both = (answer & truth).sum((1, 2))[shown]
    either = (answer | truth).sum((1, 2))[shown]
    return float((both / np.maximum(either, 1)).mean()) if shown.any() else float("nan")


def write_card(settings: TrainSettings, steps: int, n_shards: int, scores: Scores, difference: float) -> str:
    """The card as Markdown."""
    parameters = sum(parameter.numel() for parameter in Eye().parameters())
    rows = "\n".join(f"| {name} | {100 * value:.1f} |" for name, value in scores.items())
    return f"""# The network that the offline profile sees with

- **What it is**: the first 13 blocks of EfficientNet-Lite0 and a decoder, {parameters / 1e6:.1f} million parameters in
  all, that read crops of {SIDE} x {SIDE} pixels and
  answer with maps of {len(PARTS) - 1} parts ({", ".join(PARTS[1:])}) and one of {len(KINDS)} kinds of thing
  ({", ".join(KINDS)}).
- **Made by** `make train` (`python -m a4agent.offline.training`): {steps} steps of {settings.batch} crops in
  {settings.minutes:.0f} minutes on {settings.threads} CPU thread, seed {settings.seed}.
- **Starts from** the weights that Google trained on ImageNet (Apache-2.0).
- **Data**: {n_shards * shards.SIZE} pictures made by this package: drawings of tools, vessels, furniture and appliances
  with random shape, material, ground, light and camera, and renderings of the simulator benchmark's `dev` things
  (without {" and ".join(HELD_OUT)}; nothing of its `test` split). No photograph.
- **File**: weights in half precision; the probabilities of the file and of the trained network differ by
  {difference:.5f} at most.

Scores on {shards.SIZE} drawings with a seed of their own (mean IoU of a part where it is shown, share of right kinds):

| | % |
|---|---|
{rows}

**What it cannot do**: it knows the kinds above and takes other things for the nearest of them or for "other".
Things smaller than about 30 pixels, transparent things, people and animals, and parts that are told by function alone
are beyond it. Which of two ends of a tool in one material and width is the grip is often a guess.
"""
