"""Experts that need no key, no download at run time and no accelerator: the provider `offline`.

    offline:reasoner   a VisionLanguageModel made of rules over a knowledge base
    offline:parts      a Detector and a Segmenter: a small salient-object network, colour and shape

A stand-in with limits: it does not recognise objects, and looks at one object per picture.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

from a4agent.errors import ConfigError, UnknownNameError
from a4agent.protocols import Expert, Role


def create(model: str, role: Role, *, threads: int = 0) -> Expert:
    """The offline expert `model` for a role.

    Args:
        model: "reasoner" (role vlm) or "parts" (roles detector and segmenter).
        role: what it is to be.
        threads: CPU threads for the network; 0 leaves the choice to onnxruntime.

    Raises:
        UnknownNameError: there is no such model.
        MissingExtraError: a library of "parts" is not installed.
        ConfigError: the model cannot play this role.
    """
    if model not in ("reasoner", "parts"):
        raise UnknownNameError.of("offline model", model, ["reasoner", "parts"])
    if threads < 0:
        raise ConfigError(f"threads is 0 (automatic) or more, not {threads!r}")
    if model == "reasoner" and role == "vlm":
        from a4agent.offline.reasoner import OfflineReasoner

        return OfflineReasoner(threads=threads)
    if model == "parts" and role == "detector":
        from a4agent.offline.detector import OfflineDetector

        return OfflineDetector(threads=threads)
    if model == "parts" and role == "segmenter":
        from a4agent.offline.segmenter import OfflineSegmenter

        return OfflineSegmenter(threads=threads)
    plays = "a vlm" if model == "reasoner" else "a detector or a segmenter"
    raise ConfigError(f"'offline:{model}' can be {plays}, not {role!r}")


@cache
def revision() -> str:
    """Sixteen hexadecimal digits over the files of this folder, so that no cache gives an older version's answer."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.iterdir()):
        if path.suffix in (".py", ".toml", ".txt", ".onnx"):
            digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]
