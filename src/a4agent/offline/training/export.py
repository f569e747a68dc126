"""From a trained network to the file that the offline experts read, and back to see that both answer alike."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import numpy as np
import torch

from a4agent.errors import require
from a4agent.offline.training.network import SIDE, Eye

OPSET = 17


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
