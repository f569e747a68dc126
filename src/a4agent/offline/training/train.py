"""Trains the network on shards while they are being drawn. Resumes from its last checkpoint."""

from __future__ import annotations

import logging
import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from a4agent.offline.training import shards
from a4agent.offline.training.network import Eye
from a4agent.offline.vocabulary import GRIP, PARTS

log = logging.getLogger(__name__)

WEIGHTS = (0.6, 1.2, 1.2, 0.7, 1.0, 2.0, 1.2, 3.0)
"""How much a pixel of each part counts."""
KIND_SHARE = 0.4
RENEW = 16
"""Steps between two shards."""
COARSE = 128
AVERAGE = 0.998
"""The exported weights are a running average of the trained ones, with this decay a step."""


@dataclass(frozen=True)
class TrainSettings:
    """`minutes` of training, the length of the learning rate's cosine; `steps` cuts it short.

    Up to the share `coarse_until` of it crops are reduced to 128 pixels, which takes 60 % of the time.
    After the share `plain_from` of it only the plainer half of the drawings is shown: most photographs of one thing
    are plainer than the wildest drawings.
    """

    minutes: float = 160.0
    batch: int = 32
    rate: float = 2e-3
    encoder_rate: float = 4e-4
    coarse_until: float = 0.75
    pretrained: bool = True
    steps: int | None = None
    plain_from: float = 0.6
    threads: int = 1
    seed: int = 0
    checkpoint_seconds: float = 120.0


def loss_of(parts: Tensor, kinds: Tensor, true_parts: Tensor, true_kinds: Tensor, weights: Tensor) -> Tensor:
    """Cross-entropy of parts and kinds, and one minus the Dice of the parts that are there."""
    pixels = nn.functional.cross_entropy(parts, true_parts, weight=weights)
    shown = parts.softmax(1)[:, GRIP:]
    true = nn.functional.one_hot(true_parts, len(PARTS)).permute(0, 3, 1, 2)[:, GRIP:].to(shown.dtype)
    both, sizes = (shown * true).sum((2, 3)), shown.sum((2, 3)) + true.sum((2, 3))
    there = (true.sum((2, 3)) > 20).to(shown.dtype)
    dice = (there * (1 - (2 * both + 1) / (sizes + 1))).sum() / there.sum().clamp(min=1)
    names = nn.functional.cross_entropy(kinds, true_kinds, label_smoothing=0.05)
    return pixels + 0.3 * dice + KIND_SHARE * names


def train(folder: Path, checkpoint: Path, settings: TrainSettings) -> tuple[Eye, int]:
    """Train on the shards in `folder` until the time is up; returns the averaged network and the steps taken."""
    torch.set_num_threads(settings.threads)
    torch.manual_seed(settings.seed)
    network = Eye()
    if settings.pretrained:
        network.encoder.load_imagenet()
    network = network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    average = torch.optim.swa_utils.AveragedModel(
        network, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(AVERAGE), use_buffers=True
    )
    encoder = list(network.encoder.parameters())
    groups = [
        {"params": encoder, "peak": settings.encoder_rate if settings.pretrained else settings.rate},
        {"params": list(network.parameters())[len(encoder) :], "peak": settings.rate},
    ]
    optimizer = torch.optim.AdamW(groups, lr=settings.rate, weight_decay=0.01)
    step, spent = 0, 0.0
    if checkpoint.exists():
        saved = torch.load(checkpoint, weights_only=True)
        network.load_state_dict(saved["network"])
        average.load_state_dict(saved["average"])
        optimizer.load_state_dict(saved["optimizer"])
        step, spent = saved["step"], saved["spent"]
        log.info("resumed at step %d after %.1f minutes", step, spent / 60)
    pool = shards.Pool(folder, np.random.default_rng([settings.seed, step]))
    for _ in range(min(shards.POOL, len(shards.found(folder)))):
        pool.renew(calm=spent > 60 * settings.minutes * settings.plain_from)
    weights = torch.tensor(WEIGHTS)
    started = last_saved = time.monotonic()
    running: list[float] = []
    network.train()
    while True:
        before = spent + time.monotonic() - started
        share = before / (60 * settings.minutes) if settings.steps is None else step / settings.steps
        if share >= 1:
            break
        warm = min(1.0, (step + 1) / 100)
        for group in optimizer.param_groups:
            group["lr"] = group["peak"] * warm * (0.01 + 0.99 * (1 + math.cos(math.pi * share)) / 2)
        if step % RENEW == 0:
            pool.renew(calm=share > settings.plain_from)
        crops, true_parts, true_kinds = pool.batch(settings.batch)
        if share < settings.coarse_until:
            crops = nn.functional.interpolate(crops, (COARSE, COARSE), mode="bilinear", antialias=True)
            true_parts = nn.functional.interpolate(true_parts[:, None].float(), (COARSE, COARSE))[:, 0].long()
        parts, kinds = network(crops.contiguous(memory_format=torch.channels_last))
        # A quarter of the pixels, another one each time, is as good and saves a fifth of the time.
        quarter = (slice(None), slice(step % 2, None, 2), slice(step // 2 % 2, None, 2))
        seen, true = parts[(slice(None), *quarter)], true_parts[quarter].contiguous()
        loss = loss_of(seen, kinds, true, true_kinds, weights)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 2.0)
        optimizer.step()
        average.update_parameters(network)
        running.append(loss.item())
        step += 1
        if step % 100 == 0:
            log.info("step %d, %.1f minutes, loss %.3f", step, before / 60, np.mean(running[-100:]))
        if time.monotonic() - last_saved > settings.checkpoint_seconds:
            _save(checkpoint, network, average, optimizer, step, spent + time.monotonic() - started, settings)
            last_saved = time.monotonic()
    _save(checkpoint, network, average, optimizer, step, spent + time.monotonic() - started, settings)
    trained = average.module
    assert isinstance(trained, Eye)
    return trained.eval(), step


def _save(
    path: Path,
    network: Eye,
    average: nn.Module,
    optimizer: torch.optim.Optimizer,
    step: int,
    spent: float,
    settings: TrainSettings,
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    whole = path.with_suffix(".new")
    saved = {"network": network.state_dict(), "average": average.state_dict(), "optimizer": optimizer.state_dict()}
    torch.save({**saved, "step": step, "spent": spent, "settings": asdict(settings)}, whole)
    whole.replace(path)
