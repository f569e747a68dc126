"""What drawings are made of: outlines (n, 2) in units of a thing's length, paint, patches of both, and whole things."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass, replace

import numpy as np

Rng = np.random.Generator


def ellipse(x: float, y: float, a: float, b: float, power: float = 2.0, egg: float = 0.0, n: int = 48) -> np.ndarray:
    """A superellipse with half axes `a` and `b`; `egg` widens the end at +x."""
    t = np.linspace(0, 2 * np.pi, n, endpoint=False)
    c, s = np.cos(t), np.sin(t)
    return np.stack(
        [x + a * np.sign(c) * np.abs(c) ** (2 / power), y + b * (1 + egg * c) * np.sign(s) * np.abs(s) ** (2 / power)],
        1,
    )


def widths(rng: Rng, start: float, end: float, wobble: float = 0.12, n: int = 32) -> np.ndarray:
    """Widths (n,) from `start` to `end` with a few smooth swellings."""
    t = np.linspace(0, 1, n)
    w = start + (end - start) * t
    for k in range(1, 4):
        w = w * (1 + wobble / k * rng.normal() * np.sin(np.pi * k * t + rng.uniform(0, 6)))
    return np.clip(w, 0.3 * min(start, end), 2.0 * max(start, end))


def strip(path: np.ndarray, width: np.ndarray | float) -> np.ndarray:
    """The band of `width` around a path (n, 2)."""
    along = np.gradient(path, axis=0)
    normal = np.stack([-along[:, 1], along[:, 0]], 1) / np.maximum(np.hypot(*along.T), 1e-6)[:, None]
    half = np.broadcast_to(np.asarray(width, float) / 2, (len(path),))[:, None]
    return np.concatenate([path + normal * half, (path - normal * half)[::-1]])


def line(x0: float, y0: float, x1: float, y1: float, bend: float = 0.0, n: int = 32) -> np.ndarray:
    """A path (n, 2), bowed sideways by `bend`."""
    t = np.linspace(0, 1, n)
    dx, dy = x1 - x0, y1 - y0
    length = max(float(np.hypot(dx, dy)), 1e-6)
    bow = bend * np.sin(np.pi * t)
    return np.stack([x0 + dx * t - dy / length * bow, y0 + dy * t + dx / length * bow], 1)


def arc(x: float, y: float, a: float, b: float, start: float, end: float, n: int = 40) -> np.ndarray:
    """A path (n, 2) along an ellipse from one angle to another (degrees)."""
    t = np.radians(np.linspace(start, end, n))
    return np.stack([x + a * np.cos(t), y + b * np.sin(t)], 1)


def rectangle(x0: float, y0: float, x1: float, y1: float) -> np.ndarray:
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], float)


def blob(rng: Rng, x: float, y: float, radius: float, rough: float = 0.35, n: int = 60) -> np.ndarray:
    """A smooth random closed outline."""
    t = np.linspace(0, 2 * np.pi, n, endpoint=False)
    r = np.ones(n)
    for k in range(1, 6):
        r += rough / k * rng.normal() * np.cos(k * t + rng.uniform(0, 6))
    r = radius * np.clip(r, 0.25, 2)
    return np.stack([x + r * np.cos(t), y + r * np.sin(t)], 1)


def rotate(outline: np.ndarray, degrees: float, x: float = 0.0, y: float = 0.0) -> np.ndarray:
    """The outline turned about a point."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return (outline - [x, y]) @ np.array([[c, s], [-s, c]]) + [x, y]


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


@dataclass(frozen=True, eq=False)
class Patch:
    """One outline (n, 2) of one part in one material. Part 0 with `paint` None is a hole."""

    outline: np.ndarray
    part: int
    paint: Paint | None


@dataclass(frozen=True, eq=False)
class DrawnThing:
    """Pieces from back to front; y down. `upright` things stand, others lie at any angle."""

    kind: str
    pieces: list[Patch]
    upright: bool = False
