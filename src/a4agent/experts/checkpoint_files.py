"""Check that a checkpoint's files are complete, without network access.

    damage_in(Path(".../snapshots/1a2b3c"))
        -> ["model-00002-of-00004.safetensors: ends after 1.2 of 4.9 GB"]

The header of a safetensors file gives the file's length. In the hub's cache a file is named by the digest of its
contents (sha256, or git's sha1 for small ones), so every byte can be checked.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

_SHA256, _GIT_SHA1 = re.compile(r"[0-9a-f]{64}"), re.compile(r"[0-9a-f]{40}")
_BLOCK = 1 << 20
_LONGEST_HEADER = 100_000_000  # the format's own limit


def damage_in(path: Path, *, contents: bool = True, on_file: Callable[[Path], None] | None = None) -> list[str]:
    """What is wrong with a checkpoint's folder, or with one file of weights; [] if nothing is.

    Args:
        path: a folder or a .safetensors file.
        contents: also read every byte of files whose digest is known (they lie in the hub's cache).
        on_file: called with each file before it is read.
    """
    files = sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]
    found: list[str] = []
    if path.is_dir():
        is_checkpoint = any((path / name).is_file() for name in ("config.json", "model_index.json"))
        lacks = "there is no config.json or model_index.json: not a checkpoint"
        found = missing_files(path) if is_checkpoint else [lacks]
    for file in files:
        if on_file is not None:
            on_file(file)
        wrong = _wrong_with(file) or (_wrong_contents(file) if contents else "")
        if wrong:
            found.append(f"{file.relative_to(path) if path.is_dir() else file.name}: {wrong}")
    return found


def missing_files(folder: Path) -> list[str]:
    """The files that a checkpoint's folder lacks: weights, shards, parts of a pipeline."""
    if not _has_weights(folder):
        return ["there are no .safetensors files"]
    found = [
        f"{name}: {'no weights' if (folder / name).is_dir() else 'missing'}"
        for name in _parts_of_pipeline(folder)
        if not (folder / name).is_dir()
        or ((folder / name / "config.json").is_file() and not _has_weights(folder / name))
    ]
    for index in sorted(folder.rglob("*.safetensors.index.json")):
        try:
            shards = set(json.loads(index.read_text("utf-8"))["weight_map"].values())
        except (ValueError, KeyError, TypeError, AttributeError):
            continue  # reported with the file itself
        found += [
            f"{(index.parent / shard).relative_to(folder)}: missing"
            for shard in sorted(shards)
            if not (index.parent / shard).is_file()
        ]
    return found


def _has_weights(folder: Path) -> bool:
    return any(file.is_file() for pattern in ("*.safetensors", "pytorch_model*.bin") for file in folder.rglob(pattern))


def _parts_of_pipeline(folder: Path) -> list[str]:
    """The sub-folders that model_index.json names, as {"vae": ["diffusers", "AutoencoderKL"], ...}; not null ones."""
    try:
        index: Any = json.loads((folder / "model_index.json").read_text("utf-8"))
        return sorted(name for name, part in index.items() if isinstance(part, list) and None not in part)
    except (OSError, ValueError, AttributeError):
        return []


def _wrong_with(file: Path) -> str:
    if file.suffix == ".safetensors":
        return _wrong_length(file)
    if file.suffix == ".json":
        try:
            data = json.loads(file.read_text("utf-8"))
        except ValueError as error:
            return f"not JSON ({error})"
        is_index = file.name.endswith(".index.json")
        if is_index and not (isinstance(data, dict) and isinstance(data.get("weight_map"), dict)):
            return "an index without its weight_map"
    return ""


def _wrong_length(file: Path) -> str:
    size = file.stat().st_size
    try:
        with file.open("rb") as stream:
            length = int.from_bytes(stream.read(8), "little")
            if not 0 < length <= min(size, _LONGEST_HEADER):
                return "its header is cut off"
            header: dict[str, Any] = json.loads(stream.read(length))
        ends = [int(entry["data_offsets"][1]) for name, entry in header.items() if name != "__metadata__"]
    except (ValueError, KeyError, IndexError, TypeError, AttributeError):
        return "its header is damaged"
    needed = 8 + length + max(ends, default=0)
    if size == needed:
        return ""
    if size > needed:
        return f"holds {size - needed} bytes too many"
    return f"ends after {size / 1e9:.1f} of {needed / 1e9:.1f} GB" if needed > 1e8 else f"lacks {needed - size} bytes"


def _wrong_contents(file: Path) -> str:
    """Compare with the digest that names the file in the hub's cache; "" if it has no such name."""
    name = file.resolve().name
    if _SHA256.fullmatch(name):
        digest = hashlib.sha256()
    elif _GIT_SHA1.fullmatch(name):
        digest = hashlib.sha1(f"blob {file.stat().st_size}\0".encode(), usedforsecurity=False)
    else:
        return ""
    with file.open("rb") as stream:
        while block := stream.read(_BLOCK):
            digest.update(block)
    return "" if digest.hexdigest() == name else "its contents have changed since they were fetched"
