"""Start `transformers serve FOLDER --port N ...`, also where torchvision lacks its compiled half.

Beside a CPU build of torch, torchvision of the index cannot load its operators, and every import of a
Qwen-VL model fails. What such a model needs of them (their names, and decoding a picture) is supplied here.
"""

from __future__ import annotations

import io
import sys
from typing import Any


def _supply_torchvision() -> None:
    import numpy as np
    import torch
    from PIL import Image

    for name in ("nms", "qnms"):
        torch.library.define(f"torchvision::{name}", "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    import torchvision.io

    def decode_image(data: Any, mode: Any = None, apply_exif_orientation: bool = False) -> torch.Tensor:
        file = io.BytesIO(data.numpy().tobytes()) if isinstance(data, torch.Tensor) else data
        return torch.from_numpy(np.array(Image.open(file).convert("RGB"))).permute(2, 0, 1)

    torchvision.io.decode_image = torchvision.io.image.decode_image = decode_image


def main() -> None:
    """Serve; the arguments are those of `transformers serve`."""
    try:
        import torchvision  # noqa: F401
    except RuntimeError:
        for name in [name for name in sys.modules if name.partition(".")[0] == "torchvision"]:
            del sys.modules[name]
        _supply_torchvision()
    from transformers.cli.transformers import main as transformers

    sys.argv = ["transformers", "serve", *sys.argv[1:]]
    transformers()


if __name__ == "__main__":
    main()
