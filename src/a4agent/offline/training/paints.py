"""Materials: what a piece of a drawing looks like."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass, replace

import numpy as np

from a4agent.offline.training.outlines import Rng


@dataclass(frozen=True, eq=False)
class Paint:
    """`colour` (3,) RGB 0..255; `relief` how round it is shaded; `gloss` the strength of highlights;
    `grain` the strength of its texture; `bands` bright and dark stripes along `axis` (degrees), as on metal;
    `tube` shades across `axis` as on a cylinder."""

    colour: np.ndarray
    relief: float = 0.3
    gloss: float = 0.2
    grain: float = 5.0
    bands: float = 0.0
    tube: float = 0.0
    axis: float = 0.0

    def shade(self, factor: float, **changes: float) -> Paint:
        """The same material, lighter or darker."""
        return replace(self, colour=np.clip(self.colour * factor, 0, 255), **changes)  # pyright: ignore[reportArgumentType]


def any_colour(rng: Rng) -> np.ndarray:
    """White, grey and black often, wood sometimes, else any hue."""
    pick = rng.random()
    if pick < 0.16:
        return np.clip(rng.uniform(195, 252) + rng.normal(0, 6, 3), 0, 255)
    if pick < 0.34:
        return np.clip(rng.uniform(8, 60) + rng.normal(0, 5, 3), 0, 255)
    if pick < 0.44:
        return np.clip(rng.uniform(60, 195) + rng.normal(0, 7, 3), 0, 255)
    if pick < 0.56:
        return wood(rng)
    return np.array(colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.25, 1), rng.uniform(0.25, 1))) * 255


def wood(rng: Rng) -> np.ndarray:
    return np.array(colorsys.hsv_to_rgb(rng.uniform(0.04, 0.12), rng.uniform(0.2, 0.75), rng.uniform(0.25, 0.9))) * 255


def plain(rng: Rng) -> Paint:
    """Plastic, wood, rubber, enamel."""
    return Paint(
        any_colour(rng),
        relief=rng.uniform(0.0, 0.6),
        gloss=max(0.0, rng.normal(0.15, 0.25)),
        grain=rng.uniform(0, 12),
        tube=rng.uniform(0, 0.7) * (rng.random() < 0.5),
    )


def metal(rng: Rng) -> Paint:
    """Bare metal: greys with sheen, sometimes brass, copper or blackened."""
    pick = rng.random()
    grey = np.clip(rng.uniform(95, 240) + rng.normal(0, 4, 3) + [0, 0, rng.uniform(-6, 12)], 0, 255)
    if pick < 0.08:
        grey = np.array([200, 150, 80]) * rng.uniform(0.6, 1.2)
    elif pick < 0.2:
        grey = np.clip(rng.uniform(25, 90) + rng.normal(0, 4, 3), 0, 255)
    return Paint(
        np.clip(grey, 0, 255),
        relief=rng.uniform(0, 0.6),
        gloss=rng.uniform(0, 0.9),
        grain=rng.uniform(0, 7),
        bands=rng.uniform(0, 0.55) * (rng.random() < 0.7),
        tube=rng.uniform(0, 0.5) * (rng.random() < 0.4),
    )
