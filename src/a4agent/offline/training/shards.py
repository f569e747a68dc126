"""Drawings on disk: `shard-SEED-INDEX.npz`, 512 drawings each, written by one process and read by another."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from a4agent.offline.training.drawings import Drawing, draw
from a4agent.offline.vocabulary import KINDS

SIZE = 512


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
