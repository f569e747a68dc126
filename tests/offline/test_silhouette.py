"""The object is cut out, whatever the size of the photograph and whatever lies behind it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from a4agent.offline.silhouette import find_object

NAMES = ["screwdriver", "spoon", "mug", "pan"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("degrees", [0, 65, 140])
def test_the_whole_object(name: str, degrees: float, request: pytest.FixtureRequest, overlap) -> None:
    drawing = request.getfixturevalue(name)(degrees=degrees)
    found = find_object(np.asarray(drawing.image))
    assert found is not None
    assert overlap(found.to_image(found.mask, drawing.image.size), drawing.parts["whole"]) > 0.85


@pytest.mark.parametrize("size", [(120, 90), (1920, 1440), (3000, 2250)])
def test_the_size_of_the_photograph_does_not_matter(size: tuple[int, int], screwdriver, overlap) -> None:
    drawing = screwdriver()
    found = find_object(np.asarray(drawing.image.resize(size, Image.Resampling.LANCZOS)))
    assert found is not None
    assert max(found.mask.shape) <= 700
    truth = np.asarray(Image.fromarray(drawing.parts["whole"]).resize(size, Image.Resampling.NEAREST))
    assert overlap(found.to_image(found.mask, size), truth) > 0.8


def test_a_soft_shadow_belongs_to_the_table(pan, overlap) -> None:
    drawing = pan()
    light = np.asarray(drawing.image).astype(np.float32)
    y, x = np.mgrid[: light.shape[0], : light.shape[1]]
    shadow = 1 - 0.3 * np.exp(-(((x - 200) / 90) ** 2 + ((y - 235) / 40) ** 2))
    shaded = np.where(drawing.parts["whole"][..., None], light, light * shadow[..., None]).astype(np.uint8)
    found = find_object(shaded)
    assert found is not None
    assert overlap(found.to_image(found.mask, drawing.image.size), drawing.parts["whole"]) > 0.8


@pytest.mark.parametrize("colour", [0, 128, 255])
def test_nothing_stands_out_of_an_even_picture(colour: int) -> None:
    assert find_object(np.full((200, 300, 3), colour, np.uint8)) is None


@settings(max_examples=8, deadline=None)
@given(st.integers(1, 64), st.integers(1, 64), st.integers(0, 2**31))
def test_noise_of_any_size_does_no_harm(width: int, height: int, seed: int) -> None:
    found = find_object(np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8))
    if found is not None:
        assert found.to_image(found.mask, (width, height)).shape == (height, width)
