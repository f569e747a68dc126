"""What stands out is found, in pictures of any size."""

from __future__ import annotations

import numpy as np
import pytest

from a4agent.offline import saliency


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
