"""Outlines (n, 2) that drawings are made of, in units of the thing's length."""

from __future__ import annotations

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
