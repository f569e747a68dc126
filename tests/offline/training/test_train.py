"""A toy training run: it learns, and goes on after a stop."""

from __future__ import annotations

from pathlib import Path

import pytest

torch = pytest.importorskip("torch", reason="the extra 'train' is not installed")

from a4agent.offline.training import shards  # noqa: E402
from a4agent.offline.training.network import SIDE  # noqa: E402
from a4agent.offline.training.train import TrainSettings, train  # noqa: E402


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shards")
    shards.draw_shard(folder, 0, 0, size=48)
    return folder


def test_a_toy_run_learns_and_resumes(folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    checkpoint = tmp_path / "checkpoint.pt"
    _, steps = train(folder, checkpoint, TrainSettings(batch=8, steps=6, pretrained=False))
    assert steps == 6
    with caplog.at_level("INFO"):
        network, steps = train(folder, checkpoint, TrainSettings(batch=8, steps=9, pretrained=False))
    assert "resumed at step 6" in caplog.text
    assert steps == 9
    maps, kinds = network(torch.zeros(1, 3, SIDE, SIDE))
    assert maps.shape == (1, 8, SIDE, SIDE)
    assert kinds.shape == (1, 32)
