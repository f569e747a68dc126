"""Things with an inside: a profile turned about an upright axis, seen from `tilt` above the horizon."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from a4agent.offline.training.pieces import (
    DrawnThing,
    Paint,
    Patch,
    Rng,
    arc,
    ellipse,
    line,
    metal,
    plain,
    rotate,
    strip,
    widths,
)
from a4agent.offline.vocabulary import BODY, GRIP, INSIDE, LID, NOTHING, SPOUT

SAUCERS = 0.18
"""The share of mugs and cups that stand on one."""


def _turned(heights: np.ndarray, radii: np.ndarray, squash: float) -> np.ndarray:
    """The outline of a turned body: the hull of its rings, which look like ellipses squashed by `squash`."""
    left = np.stack([-radii, -heights], 1)
    right = np.stack([radii, -heights], 1)
    foot = arc(0, -heights[0], radii[0], radii[0] * squash, 0, 180)
    top = arc(0, -heights[-1], radii[-1], radii[-1] * squash, 180, 360)
    return np.concatenate([foot, left, top, right[::-1]])


def _profile(rng: Rng, height: float, foot: float, top: float, belly: float) -> tuple[np.ndarray, np.ndarray]:
    t = np.linspace(0, 1, 30)
    return height * t, np.maximum(foot + (top - foot) * t ** rng.uniform(0.5, 1.6) + belly * np.sin(np.pi * t), 0.02)


def _vessel(
    rng: Rng, height: float, foot: float, top: float, belly: float, squash: float, paint: Paint, inside: Paint
) -> list[Patch]:
    """An open body with its inside and rim, standing at y = 0."""
    tall = height * np.sqrt(1 - squash**2)
    heights, radii = _profile(rng, tall, foot, top, belly)
    pieces = [Patch(_turned(heights, radii, squash), BODY, paint)]
    r = radii[-1]
    if rng.random() < 0.5:  # a band or a print on the side
        y = -tall * rng.uniform(0.2, 0.7)
        at = float(np.interp(-y, heights, radii))
        if rng.random() < 0.5:
            path = arc(0, y, at * 0.985, at * squash, 10, 170)
            pieces.append(Patch(strip(path, tall * rng.uniform(0.03, 0.25)), BODY, plain(rng)))
        else:
            for _ in range(rng.integers(1, 6)):
                u, v = rng.uniform(-0.6, 0.6) * at, y + rng.normal() * tall * 0.1 + at * squash * 0.7
                pieces.append(
                    Patch(
                        rotate(
                            ellipse(u, v, rng.uniform(0.02, 0.15), rng.uniform(0.01, 0.1), rng.uniform(2, 5)),
                            rng.uniform(0, 180),
                            u,
                            v,
                        ),
                        BODY,
                        plain(rng),
                    )
                )
    rim = rng.uniform(0.8, 0.97)
    pieces.append(Patch(ellipse(0, -tall, r, r * squash), BODY, paint.shade(rng.uniform(0.9, 1.35))))
    pieces.append(Patch(ellipse(0, -tall, r * rim, r * rim * squash), INSIDE, inside))
    if rng.random() < 0.6:  # the far wall or what it is filled with
        k, down = rng.uniform(0.5, 0.9), rng.uniform(0.05, 0.3) * r * rim * squash
        fill = inside.shade(rng.uniform(0.5, 1.3)) if rng.random() < 0.6 else plain(rng)
        pieces.append(
            Patch(ellipse(0, -tall + down, r * rim * k, max(r * rim * squash * k - down * 0.3, 0.004)), INSIDE, fill)
        )
    return pieces


def _inside_of(rng: Rng, paint: Paint) -> Paint:
    base = paint if rng.random() < 0.65 else plain(rng)
    return base.shade(rng.uniform(0.45, 1.1), relief=-rng.uniform(0.1, 0.9), tube=-rng.uniform(0, 0.6), gloss=0.2)


def _round(rng: Rng, share_metal: float) -> Paint:
    base = metal(rng) if rng.random() < share_metal else plain(rng)
    return base.shade(1, tube=rng.uniform(0.15, 0.8), relief=rng.uniform(0, 0.2))


def _squash(rng: Rng) -> float:
    """Sine of the angle from which it is seen."""
    return float(np.sin(np.radians(rng.uniform(6, 82))))


def _handle(
    rng: Rng, x: float, y0: float, y1: float, reach: float, paint: Paint, azimuth: float, squash: float
) -> Patch:
    """A loop on the side at `azimuth` (0 to the right, 90 towards us), seen with the vessel."""
    t = np.linspace(-np.pi / 2, np.pi / 2, 36)
    power = rng.uniform(0.6, 1.2)
    out = x * 0.93 + reach * np.abs(np.cos(t)) ** power
    up = (y0 + y1) / 2 + (y1 - y0) / 2 * np.sin(t)
    c, s = np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))
    path = np.stack([out * c, up + out * s * squash], 1)
    thick = rng.uniform(0.05, 0.13) * (0.7 + 0.3 * abs(c))
    return Patch(strip(path, widths(rng, thick, thick, 0.1, 36)), GRIP, paint)


def _saucer(rng: Rng, foot: float, squash: float, paint: Paint) -> list[Patch]:
    """What some cups stand on, which is not a part of them."""
    if rng.random() > SAUCERS:
        return []
    radius = foot * rng.uniform(1.5, 2.4)
    below = radius * squash * rng.uniform(0, 0.1)
    paint = paint.shade(rng.uniform(0.8, 1.2)) if rng.random() < 0.6 else plain(rng)
    rings = [Patch(ellipse(0, below, radius, radius * squash), NOTHING, paint)]
    if rng.random() < 0.7:
        inner = radius * rng.uniform(0.5, 0.85)
        rings.append(Patch(ellipse(0, below, inner, inner * squash), NOTHING, paint.shade(rng.uniform(0.75, 1.2))))
    return rings


def mug(rng: Rng) -> DrawnThing:
    paint = _round(rng, 0.1)
    squash = _squash(rng)
    height, top = rng.uniform(0.75, 1.35), 0.5
    foot = top * rng.uniform(0.6, 1.08)
    azimuth = float(rng.choice([0, 180])) + rng.uniform(-65, 65)
    tall = height * np.sqrt(1 - squash**2)
    y1, y0 = -tall * rng.uniform(0.75, 0.95), -tall * rng.uniform(0.08, 0.4)
    grip = paint if rng.random() < 0.8 else plain(rng)
    handle = _handle(rng, (foot + top) / 2, y0, y1, rng.uniform(0.22, 0.48), grip, azimuth, squash)
    body = _vessel(rng, height, foot, top, rng.normal() * 0.04, squash, paint, _inside_of(rng, paint))
    front = np.sin(np.radians(azimuth)) > 0
    pieces = [*body[:1], handle, *body[1:]] if front else [handle, *body]
    return DrawnThing("mug", [*_saucer(rng, foot, squash, paint), *pieces], upright=True)


def cup(rng: Rng) -> DrawnThing:
    paint = _round(rng, 0.12)
    squash = _squash(rng)
    height, top = rng.uniform(0.7, 1.7), 0.5
    foot = top * rng.uniform(0.5, 1.0)
    body = _vessel(rng, height, foot, top, rng.normal() * 0.05, squash, paint, _inside_of(rng, paint))
    return DrawnThing("cup", [*_saucer(rng, foot, squash, paint), *body], upright=True)


def bowl(rng: Rng) -> DrawnThing:
    paint = _round(rng, 0.2)
    squash = float(np.sin(np.radians(rng.uniform(18, 88))))
    height = rng.uniform(0.18, 0.6)
    return DrawnThing(
        "bowl",
        _vessel(rng, height, rng.uniform(0.15, 0.4), 0.5, rng.uniform(0, 0.12), squash, paint, _inside_of(rng, paint)),
        upright=True,
    )


def pan(rng: Rng) -> DrawnThing:
    paint = metal(rng) if rng.random() < 0.6 else plain(rng)
    paint = paint.shade(1, tube=rng.uniform(0, 0.6))
    squash = float(np.sin(np.radians(rng.uniform(20, 88))))
    height = rng.uniform(0.1, 0.6)
    tall = height * np.sqrt(1 - squash**2)
    grip = paint if rng.random() < 0.4 else plain(rng)
    azimuth = rng.uniform(0, 360)
    c, s = np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth)) * squash
    body = _vessel(rng, height, rng.uniform(0.35, 0.5), 0.5, 0, squash, paint, _inside_of(rng, paint))
    level = -tall * rng.uniform(0.6, 1.0)
    pieces: list[Patch] = []
    if rng.random() < 0.75:
        length = rng.uniform(0.5, 1.2)
        rise = -rng.uniform(0, 0.25) * length
        path = line(0.45 * c, level + 0.45 * s, (0.5 + length) * c, level + (0.5 + length) * s + rise)
        pieces.append(
            Patch(strip(path, widths(rng, rng.uniform(0.06, 0.12), rng.uniform(0.08, 0.16), 0.1)), GRIP, grip)
        )
    else:  # two ears
        for sign in (-1, 1):
            ear = arc(0.5 * sign * c, level + 0.5 * sign * s, 0.14, 0.14 * max(squash, 0.35), 0, 360)
            pieces.append(Patch(strip(ear, rng.uniform(0.04, 0.07)), GRIP, grip))
    front = s > 0.02
    return DrawnThing("pan", [*body[:1], *pieces, *body[1:]] if front else [*pieces, *body], upright=True)


def bottle(rng: Rng) -> DrawnThing:
    paint = _round(rng, 0.1)
    squash = float(np.sin(np.radians(rng.uniform(2, 60))))
    tall = rng.uniform(1.0, 2.0) * np.sqrt(1 - squash**2)
    wide, neck = rng.uniform(0.22, 0.42), rng.uniform(0.07, 0.16)
    t = np.linspace(0, 1, 40)
    shoulder = rng.uniform(0.55, 0.85)
    blend = 1 / (1 + np.exp(-(t - shoulder) * rng.uniform(14, 50)))
    radii = wide * (1 - blend) + neck * blend
    heights = tall * t
    pieces = [Patch(_turned(heights, radii, squash), BODY, paint)]
    if rng.random() < 0.6:
        a, b = np.sort(rng.uniform(0.08, shoulder - 0.05, 2)) * tall
        label = np.concatenate([arc(0, -a, wide, wide * squash, 0, 180), arc(0, -b, wide, wide * squash, 180, 0)])
        pieces.append(Patch(label, BODY, plain(rng).shade(1, tube=paint.tube)))
    cap_height, cap_radius = tall * rng.uniform(0.03, 0.14), neck * rng.uniform(1.0, 1.6)
    if rng.random() < 0.8:
        cap = _round(rng, 0.2)
        pieces.append(
            Patch(_turned(np.array([tall * 0.97, tall * 0.97 + cap_height]), np.full(2, cap_radius), squash), LID, cap)
        )
        pieces.append(
            Patch(
                ellipse(0, -tall * 0.97 - cap_height, cap_radius, cap_radius * squash),
                LID,
                cap.shade(rng.uniform(0.95, 1.3)),
            )
        )
    else:
        pieces.append(Patch(ellipse(0, -tall, neck * 0.8, neck * 0.8 * squash), INSIDE, _inside_of(rng, paint)))
    return DrawnThing("bottle", pieces, upright=rng.random() < 0.8)


def kettle(rng: Rng) -> DrawnThing:
    """Kettles, teapots, jugs and thermos flasks with a handle."""
    paint = _round(rng, 0.45)
    squash = float(np.sin(np.radians(rng.uniform(5, 60))))
    height = rng.uniform(0.6, 1.4)
    tall = height * np.sqrt(1 - squash**2)
    foot, top, belly = rng.uniform(0.35, 0.5), rng.uniform(0.2, 0.45), rng.uniform(0, 0.15)
    grip = plain(rng) if rng.random() < 0.6 else paint
    turn = rng.choice([0.0, 180.0]) + rng.uniform(-55, 55)
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    heights, radii = _profile(rng, tall, foot, top, belly)
    body = Patch(_turned(heights, radii, squash), BODY, paint)
    lid_pieces: list[Patch] = []
    r = radii[-1]
    if rng.random() < 0.75:
        lid = paint.shade(rng.uniform(0.8, 1.25)) if rng.random() < 0.6 else plain(rng)
        dome = rng.uniform(0.02, 0.18)
        lid_pieces.append(
            Patch(
                np.concatenate(
                    [arc(0, -tall, r, r * squash, 0, 180), arc(0, -tall, r, dome + r * squash * 0.6, 180, 360)]
                ),
                LID,
                lid,
            )
        )
        knob = rng.uniform(0.04, 0.08)
        lid_pieces.append(Patch(ellipse(0, -tall - dome - r * squash * 0.3 - knob * 0.6, knob, knob), LID, grip))
    else:
        lid_pieces.append(Patch(ellipse(0, -tall, r, r * squash), BODY, paint.shade(1.15)))
        lid_pieces.append(Patch(ellipse(0, -tall, r * 0.9, r * 0.9 * squash), INSIDE, _inside_of(rng, paint)))
    back: list[Patch] = []
    front: list[Patch] = []
    if rng.random() < 0.35:  # a bow over the top
        rise = rng.uniform(0.3, 0.6)
        bow = arc(0, -tall * 0.95, r * rng.uniform(0.9, 1.2) * max(abs(c), 0.25), rise, 180, 360)
        front.append(Patch(strip(bow, rng.uniform(0.04, 0.1)), GRIP, grip))
    else:
        handle = _handle(
            rng,
            float(radii.mean()),
            -tall * rng.uniform(0.1, 0.4),
            -tall * rng.uniform(0.75, 1.0),
            rng.uniform(0.2, 0.45),
            grip,
            turn,
            squash,
        )
        (front if s > 0 else back).append(handle)
    if rng.random() < 0.85:
        low = -tall * rng.uniform(0.3, 0.85)
        reach = rng.uniform(0.25, 0.6)
        x0 = float(np.interp(-low, heights, radii)) * 0.9
        path = line(
            -x0 * c,
            low - x0 * s * squash,
            -(x0 + reach) * c,
            low - (x0 + reach) * s * squash - rng.uniform(0.05, 0.45),
            rng.normal() * 0.05,
        )
        spout = Patch(
            strip(path, np.linspace(rng.uniform(0.1, 0.25), rng.uniform(0.05, 0.1), 32)),
            SPOUT,
            paint if rng.random() < 0.8 else grip,
        )
        (front if s < 0 else back).append(spout)
    return DrawnThing("kettle", [*back, body, *lid_pieces, *front], upright=True)


VESSELS: dict[Callable[[Rng], DrawnThing], float] = {mug: 2.2, cup: 1.0, bowl: 1.0, pan: 1.1, bottle: 1.0, kettle: 1.7}
"""Each maker and how often it is drawn."""
