"""What several tools are made of: grips, shovel blades, slots and holes."""

from __future__ import annotations

import numpy as np

from a4agent.offline.training.pieces import Paint, Patch, Rng, ellipse, line, metal, plain, rectangle, strip, widths
from a4agent.offline.vocabulary import GRIP, NOTHING, WORK


def materials(rng: Rng, metal_share: float, same_share: float) -> tuple[Paint, Paint]:
    """Paint of grip and of working end: often unlike, sometimes one material throughout."""
    work = metal(rng) if rng.random() < metal_share else plain(rng)
    if rng.random() < same_share:
        return work.shade(rng.uniform(0.85, 1.15)), work
    return plain(rng), work


def grip_pieces(
    rng: Rng, end: float, start_width: float, end_width: float, paint: Paint, bend: float = 0.0
) -> list[Patch]:
    """A grip from 0 to `end`: swollen, waisted, with rings, rivets or a hole."""
    w = widths(rng, start_width, end_width, rng.choice([0.04, 0.12, 0.25]))
    pieces = [Patch(strip(line(0, 0, end, 0, bend), w), GRIP, paint)]
    if rng.random() < 0.75:
        pieces.append(Patch(ellipse(0.004, 0, w[0] * rng.uniform(0.15, 0.6), w[0] / 2, rng.uniform(2, 4)), GRIP, paint))
    pick = rng.random()
    if pick < 0.15:  # rivets
        for x in np.linspace(0.2, 0.8, rng.integers(2, 4)) * end:
            pieces.append(Patch(ellipse(x, bend * 0.6, w.min() * 0.14, w.min() * 0.14), GRIP, metal(rng)))
    elif pick < 0.28:  # rings or ribs
        other = paint.shade(rng.uniform(0.5, 1.5)) if rng.random() < 0.5 else plain(rng)
        for x in np.linspace(rng.uniform(0.05, 0.3), rng.uniform(0.5, 0.95), rng.integers(1, 6)) * end:
            here = float(np.interp(x / end, np.linspace(0, 1, len(w)), w))
            y = bend * np.sin(np.pi * x / end)
            pieces.append(Patch(rectangle(x, y - here / 2, x + rng.uniform(0.008, 0.03), y + here / 2), GRIP, other))
    elif pick < 0.42:  # an inlay along the middle
        other = plain(rng)
        a, b = np.sort(rng.uniform(0.05, 0.95, 2)) * end
        if b - a > 0.05:
            y0, y1 = bend * np.sin(np.pi * np.array([a, b]) / end)
            pieces.append(Patch(strip(line(a, y0, b, y1), w.min() * rng.uniform(0.2, 0.7)), GRIP, other))
    if rng.random() < 0.22:
        r = w[0] * rng.uniform(0.14, 0.3)
        pieces.append(Patch(ellipse(end * 0.07, bend * 0.2, r * rng.uniform(1, 2), r), NOTHING, None))
    return pieces


def holes(rng: Rng, x: float, a: float, b: float) -> list[Patch]:
    """Slots or round holes in a blade."""
    found: list[Patch] = []
    if rng.random() < 0.6:
        for y in np.linspace(-b, b, rng.integers(3, 6)):
            found.append(Patch(ellipse(x, y, a, max(b * 0.12, 0.004), 4), NOTHING, None))
    else:
        for _ in range(rng.integers(3, 10)):
            u, v = rng.uniform(-1, 1, 2) * [a, b]
            found.append(Patch(ellipse(x + u, v, 0.012, 0.012), NOTHING, None))
    return found


def blade_pieces(rng: Rng, g: float, work: Paint) -> list[Patch]:
    """A pointed, round or square blade from g to 1."""
    length = 1 - g
    half = length * rng.uniform(0.25, 0.5)
    t = np.linspace(0, 1, 24)
    rise = np.clip(t / rng.uniform(0.08, 0.35), 0, 1) ** rng.uniform(0.4, 1.2)
    fall = (1 - t ** rng.uniform(2, 14)) ** rng.uniform(0.5, 1)
    w = 2 * half * np.maximum(rise * fall, 0.02)
    pieces = [Patch(strip(line(g, 0, 1, 0, n=24), w), WORK, work)]
    if rng.random() < 0.65:
        inner = work.shade(rng.uniform(0.6, 1.3), relief=-rng.uniform(0, 0.6))
        k = rng.uniform(0.6, 0.9)
        pieces.append(
            Patch(strip(line(g + length * 0.1, 0, g + length * rng.uniform(0.85, 0.97), 0, n=24), w * k), WORK, inner)
        )
    if rng.random() < 0.4:  # a spine
        pieces.append(
            Patch(
                strip(line(g, 0, g + length * rng.uniform(0.3, 0.7), 0), rng.uniform(0.01, 0.03)),
                WORK,
                work.shade(rng.uniform(0.7, 1.3)),
            )
        )
    return pieces
