"""Drawings on disk: `shard-SEED-INDEX.npz`, 512 drawings each, written by one process, read by another."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from a4agent.offline.training.drawings import Drawing, draw
from a4agent.offline.training.network import SIDE
from a4agent.offline.vocabulary import KINDS

SIZE = 512
POOL = 24
"""Shards in memory at a time."""


def write(path: Path, drawings: list[Drawing]) -> None:
    """Save drawings; the file appears when it is whole."""
    images = np.stack([drawing.image for drawing in drawings])
    parts = np.stack([drawing.parts for drawing in drawings])
    kinds = np.array([KINDS.index(drawing.kind) for drawing in drawings], np.uint8)
    part_file = path.with_suffix(".part")
    with part_file.open("wb") as file:
        np.savez(file, images=images, parts=parts, kinds=kinds)
    part_file.rename(path)


def read(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """images (n, SIDE, SIDE, 3), parts (n, SIDE, SIDE), kinds (n,), all uint8."""
    with np.load(path) as saved:
        return saved["images"], saved["parts"], saved["kinds"]


def plain(images: np.ndarray, parts: np.ndarray, kinds: np.ndarray) -> np.ndarray:
    """Indices of the drawings whose background is the calmer half, and of all that show nothing."""
    grey = images.astype(np.float32).mean(3)
    steps = np.abs(np.diff(grey, axis=1))[:, :, 1:] + np.abs(np.diff(grey, axis=2))[:, 1:]
    around = parts[:, 1:, 1:] == 0
    unrest = (steps * around).sum((1, 2)) / np.maximum(around.sum((1, 2)), 1)
    nothing = kinds == KINDS.index("none")
    return np.flatnonzero((unrest <= np.median(unrest[~nothing])) | nothing)


def draw_shard(folder: Path, seed: int, index: int, size: int = SIZE) -> Path:
    """Draw one shard, unless it is there. The same seed and index give the same drawings."""
    path = folder / f"shard-{seed}-{index:05d}.npz"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        write(path, [draw(np.random.default_rng([seed, index, k])) for k in range(size)])
    return path


def found(folder: Path) -> list[Path]:
    return sorted(folder.glob("shard-*.npz"))


class Pool:
    """Random drawings out of a few shards, which change; new ones first."""

    def __init__(self, folder: Path, rng: np.random.Generator) -> None:
        self._folder, self._rng = folder, rng
        self._shards: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        self._seen: dict[Path, int] = {}

    def renew(self, calm: bool = False) -> None:
        """Take in the shard that was read least often, or the plainer half of it, and drop the oldest."""
        paths = found(self._folder)
        if not paths:
            raise FileNotFoundError(f"no shards in {str(self._folder)!r}")
        path = min(paths, key=lambda path: (self._seen.get(path, 0), self._rng.random()))
        self._seen[path] = self._seen.get(path, 0) + 1
        images, parts, kinds = read(path)
        kept = plain(images, parts, kinds) if calm else slice(None)
        self._shards = [*self._shards[-(POOL - 1) :], (images[kept], parts[kept], kinds[kept])]

    def batch(self, size: int) -> tuple[Tensor, Tensor, Tensor]:
        """Changed crops (size, 3, SIDE, SIDE) in -1..1, parts (size, SIDE, SIDE), kinds (size,)."""
        images, parts, kinds = [], [], []
        for _ in range(size):
            drawn = self._shards[self._rng.integers(len(self._shards))]
            index = self._rng.integers(len(drawn[2]))
            image, part = _moved(self._rng, drawn[0][index], drawn[1][index])
            images.append(_coloured(self._rng, image))
            parts.append(part)
            kinds.append(drawn[2][index])
        crops = torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2)
        return crops, torch.from_numpy(np.stack(parts).astype(np.int64)), torch.from_numpy(np.array(kinds, np.int64))


def _moved(rng: np.random.Generator, image: np.ndarray, parts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A crop of SIDE pixels, mirrored and turned by quarters."""
    y, x = rng.integers(0, image.shape[0] - SIDE + 1, 2)
    image, parts = image[y : y + SIDE, x : x + SIDE], parts[y : y + SIDE, x : x + SIDE]
    if rng.random() < 0.5:
        image, parts = image[:, ::-1], parts[:, ::-1]
    turn = int(rng.choice([0, 0, 1, 2, 3]))
    return np.rot90(image, turn), np.rot90(parts, turn)


def _coloured(rng: np.random.Generator, image: np.ndarray) -> np.ndarray:
    """Other gains, in -1..1 float32."""
    look = image.astype(np.float32) / 127.5 - 1
    look = look * (rng.uniform(0.7, 1.3) + rng.normal(0, 0.06, 3)) + rng.normal(0, 0.1)
    if rng.random() < 0.08:
        look[:] = look.mean(2, keepdims=True)
    elif rng.random() < 0.1:
        look = look[..., rng.permutation(3)]
    return np.clip(look, -1.2, 1.2).astype(np.float32)
