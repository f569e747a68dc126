"""The network: small, and of any size of crop that halves five times."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch", reason="the extra 'train' is not installed")

from a4agent.offline.training.network import Eye  # noqa: E402
from a4agent.offline.vocabulary import KINDS, PARTS  # noqa: E402


def test_the_network_is_small() -> None:
    assert sum(parameter.numel() for parameter in Eye().parameters()) < 2_000_000


@pytest.mark.parametrize("side", [96, 128, 160])
def test_maps_have_the_size_of_the_crop(side: int) -> None:
    with torch.no_grad():
        maps, kinds = Eye().eval()(torch.zeros(2, 3, side, side))
    assert maps.shape == (2, len(PARTS), side, side)
    assert kinds.shape == (2, len(KINDS))
