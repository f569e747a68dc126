"""Boxes in perspective, and the handles, knobs and levers on their front."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from a4agent.offline.training.pieces import Paint, Patch, Rng, ellipse, line, metal, plain, rectangle, strip
from a4agent.offline.vocabulary import BODY, GRIP


@dataclass(frozen=True, eq=False)
class BoxView:
    """A camera turned by `yaw` about the upright axis and looking down by `pitch` (radians)."""

    yaw: float
    pitch: float
    distance: float

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Points (n, 3), x right, y up, z towards us -> (n, 2), y down."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        x, z = points[:, 0] * c + points[:, 2] * s, -points[:, 0] * s + points[:, 2] * c
        c, s = np.cos(self.pitch), np.sin(self.pitch)
        y, z = points[:, 1] * c - z * s, points[:, 1] * s + z * c
        scale = self.distance / (self.distance - z)
        return np.stack([x * scale, -y * scale], 1)


def any_view(rng: Rng) -> BoxView:
    return BoxView(np.radians(rng.uniform(-55, 55)), np.radians(rng.uniform(-18, 55)), rng.uniform(2.2, 7))


def cuboid(view: BoxView, low: np.ndarray, high: np.ndarray, part: int, paint: Paint, light: float) -> list[Patch]:
    """The visible faces of a box, each as bright as it faces the light."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    faces = (
        ([[x0, y0, z0], [x0, y1, z0], [x0, y1, z1], [x0, y0, z1]], 0.85 - light),
        ([[x1, y0, z0], [x1, y1, z0], [x1, y1, z1], [x1, y0, z1]], 0.85 + light),
        ([[x0, y0, z0], [x1, y0, z0], [x1, y0, z1], [x0, y0, z1]], 0.6),
        ([[x0, y1, z0], [x1, y1, z0], [x1, y1, z1], [x0, y1, z1]], 1.2),
        ([[x0, y0, z1], [x1, y0, z1], [x1, y1, z1], [x0, y1, z1]], 1.0),
    )
    found: list[Patch] = []
    for index, (corners, bright) in enumerate(faces):
        flat = view(np.array(corners, float))
        x, y = flat[:, 0], flat[:, 1]
        turn = float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
        seen = turn < 0 if index in (1, 2, 4) else turn > 0  # these run the other way round
        if index == 4 or seen:
            found.append(Patch(flat, part, paint.shade(bright)))
    return found


def on_front(view: BoxView, outline: np.ndarray, z: float) -> np.ndarray:
    """An outline (n, 2) on the plane at depth z, y up."""
    return view(np.column_stack([outline, np.full(len(outline), z)]))


def bar_handle(
    rng: Rng, view: BoxView, x: float, y: float, length: float, z: float, upright: bool, paint: Paint
) -> list[Patch]:
    """A bar on two posts, or a bow."""
    thick = rng.uniform(0.016, 0.045)
    out = rng.uniform(0.03, 0.11)
    ends = (
        np.array([[x, y - length / 2], [x, y + length / 2]])
        if upright
        else np.array([[x - length / 2, y], [x + length / 2, y]])
    )
    pieces: list[Patch] = []
    if rng.random() < 0.3:
        t = np.linspace(0, np.pi, 24)
        path = ends[0] + (ends[1] - ends[0]) * (1 - np.cos(t))[:, None] / 2
        flat = view(np.column_stack([path, z + out * np.sin(t)]))
        return [Patch(strip(flat, thick * 1.3), GRIP, paint)]
    inset = rng.uniform(0.0, 0.15)
    for k in (inset, 1 - inset):
        foot = ends[0] + (ends[1] - ends[0]) * k
        flat = view(np.array([[*foot, z], [*foot, z + out]]))
        pieces.append(Patch(strip(line(*flat[0], *flat[1]), thick), GRIP, paint.shade(0.8)))
    flat = view(np.column_stack([ends, np.full(2, z + out)]))
    pieces.append(Patch(strip(line(*flat[0], *flat[1]), thick * rng.uniform(1, 1.7)), GRIP, paint))
    return pieces


def knob(rng: Rng, view: BoxView, x: float, y: float, radius: float, z: float, part: int, paint: Paint) -> list[Patch]:
    """A short cylinder that stands out, perhaps with a pointer."""
    out = radius * rng.uniform(0.2, 1.6)
    layers = [on_front(view, ellipse(x, y, radius, radius), z + out * k) for k in np.linspace(0, 1, 6)]
    pieces = [Patch(layer, part, paint.shade(0.7)) for layer in layers[:-1]]
    pieces.append(Patch(layers[-1], part, paint.shade(1.05)))
    if rng.random() < 0.4:
        angle = rng.uniform(0, 6.3)
        tip = np.array([x + radius * 0.9 * np.cos(angle), y + radius * 0.9 * np.sin(angle)])
        mark = strip(line(x, y, *tip), radius * rng.uniform(0.15, 0.4))
        pieces.append(Patch(on_front(view, mark, z + out), part, plain(rng)))
    return pieces


def lever_handle(rng: Rng, view: BoxView, x: float, y: float, length: float, z: float, paint: Paint) -> list[Patch]:
    """A door's lever: a rose, a neck and an arm."""
    out = rng.uniform(0.05, 0.12)
    thick = rng.uniform(0.025, 0.05)
    angle = rng.choice([0, np.pi]) + rng.uniform(-0.5, 0.5)
    end = np.array([x + length * np.cos(angle), y + length * np.sin(angle)])
    pieces = knob(rng, view, x, y, thick * rng.uniform(1, 1.8), z, GRIP, paint)
    neck = view(np.array([[x, y, z], [x, y, z + out], [*end, z + out]]))
    pieces.append(Patch(strip(line(*neck[0], *neck[1]), thick), GRIP, paint.shade(0.85)))
    pieces.append(
        Patch(strip(line(*neck[1], *neck[2], bend=rng.normal() * 0.02), thick * rng.uniform(0.9, 1.4)), GRIP, paint)
    )
    return pieces


def fitting(rng: Rng) -> Paint:
    """What handles and knobs are made of."""
    return metal(rng) if rng.random() < 0.55 else plain(rng)


def framed(rng: Rng, view: BoxView, x0: float, y0: float, x1: float, y1: float, z: float, paint: Paint) -> list[Patch]:
    """A front panel with a gap around it, perhaps with a frame or glass."""
    pieces = [Patch(on_front(view, rectangle(x0, y0, x1, y1), z), BODY, paint.shade(rng.uniform(0.3, 0.8)))]
    gap = 0.012
    pieces.append(Patch(on_front(view, rectangle(x0 + gap, y0 + gap, x1 - gap, y1 - gap), z + 0.005), BODY, paint))
    if rng.random() < 0.4:
        m = min(x1 - x0, y1 - y0) * rng.uniform(0.1, 0.25)
        inner = plain(rng) if rng.random() < 0.4 else paint.shade(rng.uniform(0.7, 1.25))
        pieces.append(Patch(on_front(view, rectangle(x0 + m, y0 + m, x1 - m, y1 - m), z + 0.005), BODY, inner))
    return pieces


def case(rng: Rng, view: BoxView, width: float, height: float, depth: float) -> tuple[list[Patch], Paint]:
    """A box whose front is at z = 0, and what it is made of."""
    paint = plain(rng) if rng.random() < 0.8 else metal(rng)
    paint = paint.shade(1, relief=0.0, tube=0.0, bands=paint.bands * 0.4)
    light = rng.normal() * 0.15
    low, high = np.array([-width / 2, -height / 2, -depth]), np.array([width / 2, height / 2, 0.0])
    return cuboid(view, low, high, BODY, paint, light), paint


def front_paint(rng: Rng, paint: Paint) -> Paint:
    """What a front is made of: often the same as its case."""
    return paint.shade(rng.uniform(0.85, 1.15)) if rng.random() < 0.6 else plain(rng).shade(1, relief=0.0, tube=0.0)
