"""Finds the pictures that two sets share by perceptual hash, also scaled, recompressed or recoloured.

    left, right = hash_images(photos), hash_images(others)     # {"mug.jpg": 64-bit hash, ...}
    shared(left, right)            -> [SharedImage("mug.jpg", "tools/0042.png", distance=2), ...]

A hash is 64 bits: the signs of the low frequencies of a small grey picture (pHash). Pictures that differ in at most
NEAR bits count as the same. Cropped or mirrored copies are not found.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image as Pillow
from PIL.Image import Image

from a4agent.errors import A4Error
from a4agent.imaging.load import load_image

NEAR = 6
"""Bits of 64. Unrelated photographs differ in 32 on average, with a deviation of 4."""
SIDE, KEPT = 32, 8


@dataclass(frozen=True)
class SharedImage:
    """Two names of one picture; `distance` is in bits."""

    left: str
    right: str
    distance: int


def perceptual_hash(image: Image) -> int:
    """64 bits that hardly change when a picture is scaled, recompressed, brightened or blurred a little."""
    from scipy.fft import dctn

    small = np.asarray(image.convert("L").resize((SIDE, SIDE), Pillow.Resampling.LANCZOS), np.float64)
    low: Any = np.asarray(dctn(small))[:KEPT, :KEPT].ravel()
    bits = low > np.median(low[1:])  # the first is the mean brightness
    return int(sum(1 << i for i, bit in enumerate(bits[1:]) if bit))


def hash_images(
    named: Iterable[tuple[str, Any]], on_image: Callable[[], None] | None = None
) -> tuple[dict[str, int], list[str]]:
    """The hashes of images (paths, bytes or pictures) by name, and what could not be read, one line each."""
    hashes: dict[str, int] = {}
    problems: list[str] = []
    for name, source in named:
        try:
            hashes[name] = perceptual_hash(load_image(source))
        except A4Error as error:
            problems.append(f"{name}: {error}")
        if on_image is not None:
            on_image()
    return hashes, problems


def shared(left: Mapping[str, int], right: Mapping[str, int], near: int = NEAR) -> list[SharedImage]:
    """The pairs whose hashes differ in at most `near` bits, the nearest first."""
    if not left or not right:
        return []
    names = list(right)
    others = np.array([right[name] for name in names], np.uint64)
    found: list[SharedImage] = []
    for name, value in left.items():
        distances = _bits(others ^ np.uint64(value))
        found += [SharedImage(name, names[i], int(distances[i])) for i in np.flatnonzero(distances <= near)]
    return sorted(found, key=lambda pair: (pair.distance, pair.left, pair.right))


def _bits(values: np.ndarray) -> np.ndarray:
    """How many bits are set in each of (n,) uint64."""
    return np.unpackbits(values.view(np.uint8).reshape(-1, 8), axis=1).sum(1)
