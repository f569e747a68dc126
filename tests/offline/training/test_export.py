"""The network's file answers as the network does, and the card says what was measured."""

from __future__ import annotations

from pathlib import Path

import pytest

torch = pytest.importorskip("torch", reason="the extra 'train' is not installed")

from a4agent.offline.training.network import Eye  # noqa: E402


def test_the_file_answers_as_the_network_does(tmp_path: Path) -> None:
    pytest.importorskip("onnx", reason="the extra 'train' is not installed")
    pytest.importorskip("onnxruntime", reason="the extra 'offline' is not installed")
    from a4agent.offline.training.export import difference, export

    torch.manual_seed(1)
    network, path = Eye().eval(), tmp_path / "eye.onnx"
    export(network, path)
    assert path.stat().st_size < 4_000_000
    assert difference(network, path) < 0.01


def test_the_card_says_what_was_measured() -> None:
    from a4agent.offline.training.export import write_card
    from a4agent.offline.training.train import TrainSettings

    card = write_card(TrainSettings(), 10, 2, {"kind": 0.5, "grip": 0.25}, 0.001)
    assert "10 steps of 32 crops" in card
    assert "| kind | 50.0 |" in card
    assert "| grip | 25.0 |" in card
