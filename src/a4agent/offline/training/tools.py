"""Hand tools and cutlery, lying along x with the grip at 0 and the working end at 1."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from a4agent.offline.training.ends import blade_pieces, grip_pieces, holes, materials
from a4agent.offline.training.pieces import (
    DrawnThing,
    Patch,
    Rng,
    arc,
    blob,
    ellipse,
    line,
    metal,
    plain,
    rectangle,
    rotate,
    strip,
    widths,
)
from a4agent.offline.vocabulary import GRIP, NOTHING, WORK


def knife(rng: Rng) -> DrawnThing:
    grip, work = materials(rng, 0.82, 0.22)
    if rng.random() < 0.6:
        work = metal(rng)
    g = rng.uniform(0.28, 0.55)
    long_thin = rng.random() < 0.4
    depth = rng.uniform(0.035, 0.09) if long_thin else rng.uniform(0.07, 0.26)
    height = np.clip(rng.uniform(0.5, 1.3) * depth, 0.04, 0.13)
    t = np.linspace(0, 1, 40)
    top = np.full(40, -depth / 2) + rng.uniform(0, 0.5) * depth * t ** rng.uniform(2, 5) * (rng.random() < 0.6)
    bottom = depth / 2 * (1 - t ** rng.uniform(1.5, 9))
    if rng.random() < 0.15:  # cleaver or butter knife: a blunt end
        bottom = np.full(40, depth / 2)
        bottom[-6:] -= np.linspace(0, depth * rng.uniform(0.1, 0.8), 6)
    bottom = np.maximum(bottom, top + 0.004)
    if rng.random() < 0.2:
        teeth = 0.004 * np.sign(np.sin(np.arange(40) * 2.5))
        bottom = bottom + teeth
    shift = (height - depth) / 2 * rng.choice([0, 1])
    x = g + t * (1 - g)
    blade = np.concatenate([np.stack([x, top + shift], 1), np.stack([x, bottom + shift], 1)[::-1]])
    pieces: list[Patch] = []
    if rng.random() < 0.3:  # bolster or guard
        pieces.append(
            Patch(rectangle(g - 0.01, -height * 0.5, g + rng.uniform(0.01, 0.05), height * 0.5), GRIP, metal(rng))
        )
    pieces.append(Patch(blade, WORK, work))
    if rng.random() < 0.5:  # the ground edge
        mid = top + (bottom - top) * rng.uniform(0.3, 0.75)
        edge = np.concatenate([np.stack([x, mid + shift], 1), np.stack([x, bottom + shift], 1)[::-1]])
        pieces.append(Patch(edge, WORK, work.shade(rng.uniform(0.75, 1.3))))
    pieces += grip_pieces(rng, g, height * rng.uniform(0.7, 1.2), height, grip, rng.normal() * 0.02)
    if rng.random() < 0.5:
        pieces = [Patch(p.outline * [1, -1], p.part, p.paint) for p in pieces]
    return DrawnThing("knife", pieces)


def hammer(rng: Rng) -> DrawnThing:
    grip, work = materials(rng, 0.7, 0.15)
    mallet = rng.random() < 0.4
    if mallet:
        work = plain(rng) if rng.random() < 0.8 else metal(rng)
    g = rng.uniform(0.68, 0.92)
    shaft = rng.uniform(0.03, 0.09)
    pieces: list[Patch] = []
    if rng.random() < 0.45:  # a shaft with a sleeve to hold
        bare = metal(rng) if rng.random() < 0.6 else plain(rng)
        pieces.append(Patch(strip(line(0, 0, g + 0.03, 0), shaft), GRIP, bare))
        pieces += grip_pieces(
            rng, g * rng.uniform(0.3, 0.65), shaft * rng.uniform(1.1, 2), shaft * rng.uniform(1.1, 1.8), grip
        )
    else:
        pieces += grip_pieces(rng, g + 0.02, rng.uniform(0.05, 0.12), shaft, grip, rng.normal() * 0.015)
    length = rng.uniform(0.22, 0.5)
    thick = rng.uniform(0.14, 0.34) if mallet else rng.uniform(0.07, 0.2)
    k = rng.uniform(0.35, 0.65)
    x = g + thick / 2
    if not mallet and rng.random() < 0.6:  # claw or peen on one side, face on the other
        t = np.linspace(0, 1, 20)
        claw = np.stack([x - rng.uniform(-0.02, 0.16) * t**2, -length * (1 - k) * t], 1)
        pieces.append(Patch(strip(claw, thick * (1 - rng.uniform(0.5, 0.9) * t)), WORK, work))
        neck = thick * rng.uniform(0.5, 1.0)
        pieces.append(Patch(rectangle(x - thick / 2, -thick * 0.4, x + thick / 2, thick * 0.4), WORK, work))
        pieces.append(Patch(rectangle(x - neck / 2, 0, x + neck / 2, length * k), WORK, work))
        face = thick * rng.uniform(0.9, 1.25)
        pieces.append(
            Patch(
                rectangle(x - face / 2, length * k * 0.75, x + face / 2, length * k),
                WORK,
                work.shade(rng.uniform(0.8, 1.2)),
            )
        )
    else:
        pieces.append(Patch(ellipse(x, length * (k - 0.5), thick / 2, length / 2, rng.uniform(2.5, 9)), WORK, work))
        if rng.random() < 0.4:
            cap = plain(rng)
            for side in rng.choice([-1, 1], rng.integers(1, 3), replace=False):
                y = length * (k - 0.5) + side * length * 0.43
                pieces.append(
                    Patch(
                        rectangle(x - thick * 0.52, y - length * 0.08, x + thick * 0.52, y + length * 0.08), WORK, cap
                    )
                )
    if rng.random() < 0.5:  # the shaft's end shows through
        pieces.append(
            Patch(rectangle(g, -shaft / 2, g + thick * rng.uniform(0.2, 1.1), shaft / 2), WORK, grip.shade(0.9))
        )
    return DrawnThing("hammer", pieces)


def spoon(rng: Rng) -> DrawnThing:
    grip, work = materials(rng, 0.5, 0.55)
    g = rng.uniform(0.5, 0.84)
    thin = rng.uniform(0.018, 0.06)
    pieces = grip_pieces(rng, g + 0.02, thin * rng.uniform(0.8, 2.6), thin, grip, rng.normal() * 0.04)
    a = (1 - g) / 2
    b = a * rng.uniform(0.5, 1.25)
    power, egg = rng.uniform(1.9, 2.8), rng.uniform(-0.3, 0.3)
    tilt = rng.normal() * 6
    pieces.append(Patch(rotate(ellipse(g + a * 0.96, 0, a, b, power, egg), tilt, g, 0), WORK, work))
    if rng.random() < 0.75:  # the hollow
        hollow = work.shade(rng.uniform(0.55, 1.35), relief=-rng.uniform(0.1, 0.8), gloss=rng.uniform(0, 1))
        k = rng.uniform(0.7, 0.92)
        at = rotate(ellipse(g + a * 0.97, rng.normal() * 0.05 * b, a * k, b * k, power, egg), tilt, g, 0)
        pieces.append(Patch(at, WORK, hollow))
    if rng.random() < 0.12:
        pieces += holes(rng, g + a, a * 0.5, b * 0.5)
    return DrawnThing("spoon", pieces)


def shovel(rng: Rng) -> DrawnThing:
    grip, work = materials(rng, 0.6, 0.35)
    g = rng.uniform(0.55, 0.78)
    thin = rng.uniform(0.03, 0.07)
    pieces = [Patch(strip(line(0.02, 0, g + 0.05, 0, rng.normal() * 0.02), thin), GRIP, grip)]
    if rng.random() < 0.5:  # a D or T at the end
        span = rng.uniform(0.05, 0.11)
        if rng.random() < 0.5:
            pieces.append(Patch(strip(arc(0.06, 0, 0.06, span, 60, 300), thin * 0.7), GRIP, grip))
        else:
            pieces.append(Patch(rectangle(0, -span, thin * 0.9, span), GRIP, plain(rng)))
    pieces += blade_pieces(rng, g, work)
    return DrawnThing("shovel", pieces)


def trowel(rng: Rng) -> DrawnThing:
    grip, work = materials(rng, 0.6, 0.45)
    g = rng.uniform(0.36, 0.52)
    h = rng.uniform(0.06, 0.13)
    neck = rng.uniform(0.02, 0.12)
    pieces = [
        Patch(strip(line(g - 0.02, 0, g + neck + 0.06, 0, rng.normal() * 0.03), rng.uniform(0.02, 0.06)), WORK, work)
    ]
    pieces += blade_pieces(rng, g + neck, work)
    pieces += grip_pieces(rng, g, h * rng.uniform(0.8, 1.3), h * rng.uniform(0.7, 1.1), grip, rng.normal() * 0.02)
    return DrawnThing("trowel", pieces)


def turner(rng: Rng) -> DrawnThing:
    grip, work = materials(rng, 0.4, 0.5)
    g = rng.uniform(0.42, 0.76)
    thin = rng.uniform(0.02, 0.05)
    n = rng.uniform(0.0, 0.3)
    pieces = [Patch(strip(line(g * (1 - n), 0, g + 0.04, 0), thin), GRIP, work)]
    pieces += grip_pieces(
        rng, g * (1 - n) + 0.01, thin * rng.uniform(1, 2.6), thin * rng.uniform(1, 1.6), grip, rng.normal() * 0.02
    )
    w0, w1 = rng.uniform(0.06, 0.3), rng.uniform(0.1, 0.34)
    slope = rng.uniform(0.02, 0.12)
    skew = rng.normal() * 0.03
    edge = np.array(
        [
            [g, -thin / 2],
            [g + slope, -w0 / 2],
            [1 + skew, -w1 / 2],
            [1 - skew, w1 / 2],
            [g + slope, w0 / 2],
            [g, thin / 2],
        ]
    )
    pieces.append(Patch(edge, WORK, work))
    if rng.random() < 0.5:
        pieces += holes(rng, (g + slope + 1) / 2, (1 - g) * 0.25, min(w0, w1) * 0.32)
    return DrawnThing("turner", pieces)


def fork(rng: Rng) -> DrawnThing:
    grip, work = materials(rng, 0.55, 0.6)
    g = rng.uniform(0.52, 0.78)
    thin = rng.uniform(0.018, 0.045)
    pieces = grip_pieces(rng, g + 0.02, thin * rng.uniform(1, 3), thin, grip, rng.normal() * 0.03)
    w = rng.uniform(0.09, 0.19)
    n = int(rng.integers(2, 6))
    root = g + (1 - g) * rng.uniform(0.3, 0.6)
    palm = np.array(
        [
            [g, -thin / 2],
            [g + (root - g) * 0.6, -w / 2],
            [root, -w / 2],
            [root, w / 2],
            [g + (root - g) * 0.6, w / 2],
            [g, thin / 2],
        ]
    )
    pieces.append(Patch(palm, WORK, work))
    tine = w / n * rng.uniform(0.35, 0.75)
    for y in np.linspace(-w / 2 + tine / 2, w / 2 - tine / 2, n):
        pieces.append(
            Patch(
                strip(line(root - 0.02, y, 1, y * rng.uniform(0.9, 1.1)), np.linspace(tine, tine * 0.5, 32)), WORK, work
            )
        )
    return DrawnThing("fork", pieces)


def screwdriver(rng: Rng) -> DrawnThing:
    grip, work = materials(rng, 0.92, 0.06)
    g = rng.uniform(0.32, 0.62)
    h = rng.uniform(0.09, 0.22)
    thin = rng.uniform(0.018, 0.055)
    pieces = [Patch(strip(line(g - 0.02, 0, 1, 0), thin), WORK, work)]
    if rng.random() < 0.5:
        t = rng.uniform(0.8, 1.8) * thin
        pieces.append(
            Patch(
                np.array([[0.93, -thin / 2], [0.97, -t / 2], [1, -t / 2], [1, t / 2], [0.97, t / 2], [0.93, thin / 2]]),
                WORK,
                work,
            )
        )
    pieces += grip_pieces(rng, g, h * rng.uniform(0.7, 1.1), h, grip)
    if rng.random() < 0.6:
        pieces.append(
            Patch(
                strip(line(g - 0.01, 0, g + rng.uniform(0.02, 0.09), 0), np.linspace(h * 0.8, thin * 1.6, 32)),
                GRIP,
                grip if rng.random() < 0.5 else plain(rng),
            )
        )
    return DrawnThing("screwdriver", pieces)


def brush(rng: Rng) -> DrawnThing:
    grip, work = materials(rng, 0.05, 0.1)
    g = rng.uniform(0.4, 0.82)
    h = rng.uniform(0.03, 0.12)
    pieces = grip_pieces(rng, g + 0.01, h * rng.uniform(0.6, 1.3), h, grip, rng.normal() * 0.02)
    w = rng.uniform(0.05, 0.26)
    hair = work.shade(1, grain=rng.uniform(8, 30))
    if rng.random() < 0.55:  # bristles at the end
        ferrule = rng.uniform(0.04, 0.14)
        pieces.append(Patch(strip(line(g - 0.01, 0, g + ferrule, 0), np.linspace(h, w, 32)), GRIP, metal(rng)))
        pieces.append(
            Patch(strip(line(g + ferrule, 0, 1, 0), np.linspace(w, w * rng.uniform(0.3, 1.2), 32)), WORK, hair)
        )
        for _ in range(12):
            y = rng.uniform(-0.45, 0.45) * w
            pieces.append(
                Patch(
                    strip(line(g + ferrule, y, 1 + rng.normal() * 0.01, y * 1.05), 0.006),
                    WORK,
                    hair.shade(rng.uniform(0.6, 1.35)),
                )
            )
    else:  # bristles along one side
        pieces.append(Patch(strip(line(g - 0.02, 0, 1, 0), h * rng.uniform(0.8, 1.4)), GRIP, grip))
        for x in np.linspace(g + 0.02, 0.99, rng.integers(8, 20)):
            pieces.append(
                Patch(
                    strip(line(x, h * 0.3, x + rng.normal() * 0.008, h * 0.3 + w * 0.8), (1 - g) / 14),
                    WORK,
                    hair.shade(rng.uniform(0.8, 1.2)),
                )
            )
    return DrawnThing("brush", pieces)


def scissors(rng: Rng) -> DrawnThing:
    grip, work = materials(rng, 0.85, 0.2)
    g = rng.uniform(0.34, 0.55)
    opening = rng.uniform(3, 26)
    w = rng.uniform(0.045, 0.1)
    ring = rng.uniform(0.07, 0.13)
    pieces: list[Patch] = []
    hinge = g + 0.05
    for side in (-1, 1):
        tip = rotate(strip(line(g - 0.03, 0, 1, side * 0.01), np.linspace(w, 0.008, 32)), side * opening / 2, hinge, 0)
        pieces.append(Patch(tip, WORK, work.shade(rng.uniform(0.85, 1.1))))
        loop_x, loop_y = ring * 1.1, -side * (ring * rng.uniform(0.8, 1.3) + 0.02)
        pieces.append(
            Patch(strip(line(loop_x + ring * 0.7, loop_y * 0.7, hinge, 0), rng.uniform(0.03, 0.06)), GRIP, grip)
        )
        long = rng.uniform(1, 1.5)
        pieces.append(
            Patch(strip(arc(loop_x, loop_y, ring * long, ring, 0, 360), rng.uniform(0.022, 0.05)), GRIP, grip)
        )
    pieces.append(Patch(ellipse(hinge, 0, w * 0.28, w * 0.28), WORK, metal(rng)))
    return DrawnThing("scissors", pieces)


def pliers(rng: Rng) -> DrawnThing:
    grip, work = materials(rng, 0.95, 0.12)
    g = rng.uniform(0.55, 0.75)
    spread = rng.uniform(0.06, 0.16)
    w = rng.uniform(0.04, 0.085)
    pieces: list[Patch] = []
    for side in (-1, 1):
        pieces.append(Patch(strip(line(0.25, side * spread, g + 0.06, -side * 0.01, side * 0.04), w * 0.8), WORK, work))
        end = rng.uniform(0.75, 0.97)
        leg = line(
            0, side * spread * rng.uniform(0.9, 1.3), g * end, side * spread * 0.25, side * rng.uniform(0.01, 0.06)
        )
        pieces.append(Patch(strip(leg, widths(rng, w * 1.1, w, 0.06)), GRIP, grip))
        jaw = rotate(
            strip(line(g, side * w * 0.4, 1, side * 0.012), np.linspace(w * 1.3, w * rng.uniform(0.2, 0.9), 32)),
            side * rng.uniform(0, 8),
            g,
            0,
        )
        pieces.append(Patch(jaw, WORK, work.shade(rng.uniform(0.85, 1.15))))
    pieces.append(Patch(ellipse(g + 0.01, 0, w * 1.1, w * rng.uniform(0.9, 1.3)), WORK, work))
    pieces.append(Patch(ellipse(g + 0.01, 0, w * 0.35, w * 0.35), WORK, metal(rng)))
    return DrawnThing("pliers", pieces)


def wrench(rng: Rng) -> DrawnThing:
    grip, work = materials(rng, 0.9, 0.85)
    g = rng.uniform(0.68, 0.84)
    w = rng.uniform(0.04, 0.09)
    pieces = [Patch(strip(line(0, 0, g + 0.05, 0), widths(rng, w, w, 0.05)), GRIP, grip)]
    if rng.random() < 0.4:
        pieces.append(Patch(strip(line(0.04, 0, g - 0.05, 0), w * 0.5), GRIP, grip.shade(rng.uniform(0.7, 1.3))))
    a = (1 - g) / 2
    b = a * rng.uniform(0.8, 1.2)
    pieces.append(Patch(ellipse(g + a, 0, a, b, rng.uniform(2, 3)), WORK, work))
    if rng.random() < 0.55:  # open end
        turn = rng.normal() * 15
        pieces.append(Patch(rotate(rectangle(g + a * 0.8, -b * 0.4, 1.05, b * 0.4), turn, g + a, 0), NOTHING, None))
    else:
        pieces.append(Patch(ellipse(g + a, 0, a * 0.55, b * 0.55, rng.uniform(2, 6)), NOTHING, None))
    if rng.random() < 0.4:
        pieces.append(Patch(ellipse(0.02, 0, w * 0.8, w * 0.8), GRIP, grip))
        if rng.random() < 0.6:
            pieces.append(Patch(ellipse(0.02, 0, w * 0.4, w * 0.4), NOTHING, None))
    return DrawnThing("wrench", pieces)


def saw(rng: Rng) -> DrawnThing:
    grip, work = materials(rng, 0.92, 0.05)
    g = rng.uniform(0.2, 0.34)
    w0, w1 = rng.uniform(0.14, 0.26), rng.uniform(0.05, 0.12)
    t = np.linspace(0, 1, 48)
    x = g - 0.04 + t * (1.04 - g)
    teeth = 0.008 * (np.arange(48) % 2)
    top, bottom = -w0 / 2 + (w0 - w1) * t * rng.uniform(0, 1), w0 / 2 - (w0 - w1) * t * 0.2 + teeth
    pieces = [Patch(np.concatenate([np.stack([x, top], 1), np.stack([x, bottom], 1)[::-1]]), WORK, work)]
    pieces.append(Patch(blob(rng, g * 0.5, 0, max(g * 0.5, w0 * 0.55), 0.12), GRIP, grip))
    if rng.random() < 0.8:
        pieces.append(Patch(ellipse(g * 0.45, 0, g * 0.22, w0 * rng.uniform(0.15, 0.32), 2.5), NOTHING, None))
    return DrawnThing("saw", pieces)


def other_tool(rng: Rng) -> DrawnThing:
    """A grip with an end of any shape: tools that have no name here."""
    grip, work = materials(rng, 0.4, 0.25)
    g = rng.uniform(0.4, 0.85)
    h = rng.uniform(0.03, 0.12)
    pieces = grip_pieces(rng, g + 0.02, h * rng.uniform(0.7, 1.4), h, grip, rng.normal() * 0.03)
    a = (1 - g) / 2
    pick = rng.random()
    if pick < 0.3:
        pieces.append(Patch(blob(rng, g + a, 0, a * 1.1), WORK, work))
    elif pick < 0.55:  # a ring
        pieces.append(
            Patch(strip(arc(g + a, 0, a, a * rng.uniform(0.6, 1.4), 0, 360), a * rng.uniform(0.2, 0.5)), WORK, work)
        )
    elif pick < 0.75:  # a comb or rake
        span = rng.uniform(0.1, 0.25)
        pieces.append(Patch(rectangle(g, -span, g + a * 0.6, span), WORK, work))
        for y in np.linspace(-span, span, rng.integers(4, 10)):
            pieces.append(Patch(strip(line(g + a * 0.5, y, 1, y), span / 14), WORK, work))
    else:  # a bent hook or peeler
        pieces.append(
            Patch(strip(arc(g, a, a * 1.6, a, -90, rng.uniform(20, 120)), h * rng.uniform(0.5, 1.2)), WORK, work)
        )
    return DrawnThing("other", pieces)


def plug(rng: Rng) -> DrawnThing:
    """A plug or a key: a short grip, often with a cable, and pins."""
    grip, work = plain(rng), metal(rng)
    g, h = rng.uniform(0.5, 0.75), rng.uniform(0.2, 0.5)
    pieces = [Patch(ellipse(g / 2, 0, g / 2, h / 2, rng.uniform(2.5, 6), rng.uniform(-0.3, 0.2)), GRIP, grip)]
    n, thick = int(rng.integers(1, 4)), rng.uniform(0.04, 0.1)
    for y in np.linspace(-h / 3, h / 3, n) if n > 1 else [0.0]:
        pieces.insert(0, Patch(strip(line(g - 0.05, float(y), 1, float(y)), thick), WORK, work))
    return DrawnThing("other", pieces)


TOOLS: dict[Callable[[Rng], DrawnThing], float] = {
    knife: 2.2, hammer: 1.6, spoon: 1.7, shovel: 0.8, trowel: 1.0, turner: 1.2, fork: 1.2, screwdriver: 1.3,
    brush: 0.8, scissors: 0.9, pliers: 0.7, wrench: 0.7, saw: 0.6, other_tool: 0.8, plug: 0.3,
}  # fmt: skip
"""Each maker and how often it is drawn."""
