"""Where a checkpoint lies on this disk: a model's name, or a folder, to files that are there and complete.

    find_checkpoint("facebook/sam2.1-hiera-tiny", kinds=("sam2", "sam2_video"))
        -> Checkpoint(folder=Path(".../snapshots/1a2b3c..."), revision="1a2b3c...", kind="sam2_video")

A folder is taken as it is. A name is looked up in the local cache of the hub first, without any network;
only what is not there is downloaded. Nothing here needs torch.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from a4agent.errors import ModelFilesError
from a4agent.experts import hub
from a4agent.experts.checkpoint_files import missing_files

_NAME = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")
_BLOCK, _BLOCKS = 4096, 16
_WEIGHTS = (".safetensors", ".bin")
_READ = (*_WEIGHTS, ".json", ".txt", ".jinja", ".model", ".py")


@dataclass(frozen=True)
class Checkpoint:
    """A complete checkpoint: its folder, the commit (or a digest of the files), its architecture's name."""

    folder: Path
    revision: str
    kind: str


def find_checkpoint(model: str, *, kinds: Sequence[str] = (), revision: str | None = None) -> Checkpoint:
    """The checkpoint that `model` (a folder, or OWNER/NAME on the hub) stands for, downloaded if need be.

    Args:
        model: a folder or a name.
        kinds: the architectures (`model_type` in config.json, `_class_name` in model_index.json) that will do;
            any if empty.
        revision: branch, tag or commit of a name; a folder has none.

    Raises:
        ModelFilesError: there is no such folder or name, the hub cannot be reached, files are missing, or
            the checkpoint is of another architecture.
        CredentialError: the model is gated and this account has no access.
    """
    path = Path(model).expanduser()
    if path.is_dir():
        folder, commit = path, ""
    elif path.exists():
        raise ModelFilesError(f"{model!r} is a file; give the folder that holds config.json and the weights")
    elif _NAME.fullmatch(model):
        folder = hub.cached(model, revision) or hub.fetch(model, revision)
        commit = folder.name
    else:
        raise ModelFilesError(f"there is no folder {model!r}, and the name of a model is written 'OWNER/NAME'")
    kind = _kind(model, folder)
    if kinds and kind not in kinds:
        raise ModelFilesError(f"{model!r} is a checkpoint of {kind!r}; {' or '.join(map(repr, kinds))} is needed here")
    missing = missing_files(folder)
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        remedy = "its repository has no more: choose another model" if commit else "fetch its files again"
        raise ModelFilesError(f"{model!r} is not complete: {missing[0]}{more}, in {str(folder)!r}; {remedy}")
    return Checkpoint(folder, commit or digest_of(folder), kind)


def weight_files(folder: Path) -> list[Path]:
    """The files with weights in a checkpoint's folder and its sub-folders, in a fixed order."""
    return sorted(folder.rglob("*.safetensors")) or sorted(folder.rglob("pytorch_model*.bin"))


def parameter_count(folder: Path) -> int:
    """How many numbers a checkpoint's weights are, read from the files' headers."""
    return sum(_numbers_in(file) for file in weight_files(folder))


def _numbers_in(file: Path) -> int:
    if file.suffix != ".safetensors":
        return file.stat().st_size // 2  # pickled: half precision is assumed
    with file.open("rb") as stream:
        try:
            header = json.loads(stream.read(int.from_bytes(stream.read(8), "little")))
        except (ValueError, MemoryError) as error:
            raise ModelFilesError(f"{str(file)!r} is damaged or not complete ({error}); fetch it again") from error
    return sum(math.prod(tensor["shape"]) for name, tensor in header.items() if name != "__metadata__")


def find_file(name: str, *, revision: str | None = None) -> Path:
    """One file of weights: a path on this disk, or OWNER/NAME/PATH on the hub, downloaded if need be.

    Raises:
        ModelFilesError: there is no such file, or the hub cannot be reached.
    """
    if Path(name).expanduser().is_file():
        return Path(name).expanduser()
    model, file = "/".join(name.split("/")[:2]), "/".join(name.split("/")[2:])
    if not _NAME.fullmatch(model) or not file:
        raise ModelFilesError(f"there is no file {name!r}; a file on the hub is written 'OWNER/NAME/PATH'")
    return hub.cached(model, revision, file) or hub.fetch(model, revision, file)


def _kind(model: str, folder: Path) -> str:
    for name, key in (("model_index.json", "_class_name"), ("config.json", "model_type")):
        if not (folder / name).is_file():
            continue
        try:
            data = json.loads((folder / name).read_text("utf-8"))
        except ValueError as error:
            raise ModelFilesError(f"{name} in {str(folder)!r} is damaged ({error})") from error
        value = cast("dict[str, object]", data).get(key) if isinstance(data, dict) else None
        if isinstance(value, str):
            return value
        raise ModelFilesError(f"{name} in {str(folder)!r} has no {key!r}")
    raise ModelFilesError(f"{model!r} is not a checkpoint: there is no config.json or model_index.json in it")


def digest_of(path: Path) -> str:
    """A digest of a user's folder or file: all its settings, and samples of its weights (milliseconds for any size)."""
    digest = hashlib.sha256()
    read = (file for file in sorted(path.rglob("*")) if file.suffix in _READ and file.is_file())
    for file in read if path.is_dir() else [path]:
        size = file.stat().st_size
        digest.update(f"{file.relative_to(path).as_posix()} {size}\n".encode())
        with file.open("rb") as stream:
            if file.suffix not in _WEIGHTS or size <= _BLOCK * _BLOCKS * 4:
                digest.update(stream.read())
                continue
            for k in range(_BLOCKS):
                stream.seek((size - _BLOCK) * k // (_BLOCKS - 1))
                digest.update(stream.read(_BLOCK))
    return digest.hexdigest()[:16]
