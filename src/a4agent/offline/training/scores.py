"""How well a network reads drawings that it was not trained on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from a4agent.offline.training import shards
from a4agent.offline.training.network import SIDE, Eye
from a4agent.offline.vocabulary import PARTS

Scores = dict[str, float]


def measure(network: Eye, shard: Path, batch: int = 64) -> Scores:
    """The mean IoU of each part over the drawings that show it, of the whole thing, and the share of right kinds."""
    images, parts, kinds = shards.read(shard)
    edge = (images.shape[1] - SIDE) // 2
    images, parts = (array[:, edge : edge + SIDE, edge : edge + SIDE] for array in (images, parts))
    found, named = [], []
    with torch.no_grad():
        for start in range(0, len(images), batch):
            crops = torch.from_numpy(images[start : start + batch].astype(np.float32) / 127.5 - 1)
            maps, logits = network.eval()(crops.permute(0, 3, 1, 2).contiguous())
            found.append(maps.argmax(1).numpy())
            named.append(logits.argmax(1).numpy())
    answer = np.concatenate(found)
    scores = {"kind": float((np.concatenate(named) == kinds).mean()), "whole": _iou(answer > 0, parts > 0)}
    scores |= {name: _iou(answer == k, parts == k) for k, name in enumerate(PARTS) if k}
    return scores


def _iou(answer: np.ndarray, truth: np.ndarray) -> float:
    """The mean over the drawings (n, h, w) in which there is something to find."""
    shown = truth.any((1, 2))
    both = (answer & truth).sum((1, 2))[shown]
    either = (answer | truth).sum((1, 2))[shown]
    return float((both / np.maximum(either, 1)).mean()) if shown.any() else float("nan")
