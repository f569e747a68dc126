"""The model card that is written beside the weights."""

from __future__ import annotations

from a4agent.offline.training import shards
from a4agent.offline.training.network import SIDE, Eye
from a4agent.offline.training.scores import Scores
from a4agent.offline.training.simulator import HELD_OUT
from a4agent.offline.training.train import TrainSettings
from a4agent.offline.vocabulary import KINDS, PARTS


def write(settings: TrainSettings, steps: int, n_shards: int, scores: Scores, difference: float) -> str:
    """The card as Markdown."""
    parameters = sum(parameter.numel() for parameter in Eye().parameters())
    rows = "\n".join(f"| {name} | {100 * value:.1f} |" for name, value in scores.items())
    return f"""# The network that the offline profile sees with

- **What it is**: the first 13 blocks of EfficientNet-Lite0 and a decoder, {parameters / 1e6:.1f} million parameters in
  all, that read crops of {SIDE} x {SIDE} pixels and
  answer with maps of {len(PARTS) - 1} parts ({", ".join(PARTS[1:])}) and one of {len(KINDS)} kinds of thing
  ({", ".join(KINDS)}).
- **Made by** `make train` (`python -m a4agent.offline.training`): {steps} steps of {settings.batch} crops in
  {settings.minutes:.0f} minutes on {settings.threads} CPU thread, seed {settings.seed}.
- **Starts from** the weights that Google trained on ImageNet (Apache-2.0).
- **Data**: {n_shards * shards.SIZE} pictures made by this package: drawings of tools, vessels, furniture and appliances
  with random shape, material, ground, light and camera, and renderings of the simulator benchmark's `dev` things
  (without {" and ".join(HELD_OUT)}; nothing of its `test` split). No photograph.
- **File**: weights in half precision; the probabilities of the file and of the trained network differ by
  {difference:.5f} at most.

Scores on {shards.SIZE} drawings with a seed of their own (mean IoU of a part where it is shown, share of right kinds):

| | % |
|---|---|
{rows}

**What it cannot do**: it knows the kinds above and takes other things for the nearest of them or for "other".
Things smaller than about 30 pixels, transparent things, people and animals, and parts that are told by function alone
are beyond it. Which of two ends of a tool in one material and width is the grip is often a guess.
"""
