"""Shards: written once, read back, and taken into the pool."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the extra 'train' is not installed")

from a4agent.offline.training import shards  # noqa: E402
from a4agent.offline.training.network import SIDE  # noqa: E402


def test_a_shard_is_drawn_once(tmp_path: Path) -> None:
    path = shards.draw_shard(tmp_path, 1, 0, size=4)
    written = path.stat().st_mtime_ns
    assert shards.draw_shard(tmp_path, 1, 0, size=4) == path
    assert path.stat().st_mtime_ns == written
    assert shards.found(tmp_path) == [path]
    images, parts, kinds = shards.read(path)
    assert len(images) == len(parts) == len(kinds) == 4


def test_calm_shards_show_the_plainer_half(tmp_path: Path) -> None:
    shards.draw_shard(tmp_path, 1, 0, size=16)
    pool = shards.Pool(tmp_path, np.random.default_rng(0))
    pool.renew()
    pool.renew(calm=True)
    whole, calm = (len(kinds) for _, _, kinds in pool._shards)
    assert whole == 16
    assert 0 < calm < 16
    crops, maps, kinds = pool.batch(5)
    assert crops.shape == (5, 3, SIDE, SIDE)
    assert maps.shape == (5, SIDE, SIDE)
    assert kinds.shape == (5,)


def test_no_shards_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no shards"):
        shards.Pool(tmp_path, np.random.default_rng(0)).renew()
