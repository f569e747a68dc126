"""Furniture, appliances and switches: boxes seen in perspective, with handles, knobs and buttons on their front."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from a4agent.offline.training.pieces import (
    DrawnThing,
    Patch,
    Rng,
    ellipse,
    line,
    metal,
    plain,
    rectangle,
    strip,
    widths,
)
from a4agent.offline.training.solids import (
    BoxView,
    any_view,
    bar_handle,
    case,
    cuboid,
    fitting,
    framed,
    front_paint,
    knob,
    lever_handle,
    on_front,
)
from a4agent.offline.vocabulary import BODY, CONTROL, GRIP, INSIDE, LID, SPOUT


def drawers(rng: Rng) -> DrawnThing:
    view = any_view(rng)
    w, h, d = rng.uniform(0.5, 1.2), rng.uniform(0.3, 1.1), rng.uniform(0.3, 0.9)
    pieces, paint = case(rng, view, w, h, d)
    n = int(rng.integers(1, 5)) if h > 0.5 else 1
    front, metalwork = front_paint(rng, paint), fitting(rng)
    handles: list[Patch] = []
    is_knob = rng.random() < 0.3
    for index in range(n):
        y0, y1 = -h / 2 + h * index / n, -h / 2 + h * (index + 1) / n
        z = 0.0
        pull = rng.uniform(0.1, 0.45) if rng.random() < 0.3 else 0.0
        if pull:  # a drawer that stands open, with its inside from above
            pieces += cuboid(
                view,
                np.array([-w / 2 + 0.03, y0 + 0.03, 0]),
                np.array([w / 2 - 0.03, y1 - 0.03, pull]),
                BODY,
                front,
                0.1,
            )
            top = view(
                np.array(
                    [
                        [-w / 2 + 0.06, y1 - 0.03, 0],
                        [w / 2 - 0.06, y1 - 0.03, 0],
                        [w / 2 - 0.06, y1 - 0.03, pull - 0.03],
                        [-w / 2 + 0.06, y1 - 0.03, pull - 0.03],
                    ]
                )
            )
            if view.pitch > 0.1:
                pieces.append(Patch(top, INSIDE, front.shade(rng.uniform(0.3, 0.6))))
            z = pull
        pieces += framed(rng, view, -w / 2 + 0.02, y0 + 0.015, w / 2 - 0.02, y1 - 0.015, z, front)
        y = (y0 + y1) / 2 + rng.choice([0, 0.2]) * (y1 - y0)
        if is_knob:
            handles += knob(rng, view, 0, y, rng.uniform(0.025, 0.05), z, GRIP, metalwork)
        else:
            handles += bar_handle(rng, view, 0, y, w * rng.uniform(0.15, 0.6), z, False, metalwork)
    return DrawnThing("drawer", pieces + handles, upright=True)


def doors(rng: Rng) -> DrawnThing:
    """A door, a locker, a safe, a cupboard with one or two doors, an oven or a fridge."""
    view = any_view(rng)
    pick = rng.random()
    if pick < 0.4:
        kind, w, h, d, leaves = "door", rng.uniform(0.45, 0.8), rng.uniform(0.8, 1.3), rng.uniform(0.03, 0.2), 1
    else:
        kind, w, h, d = "cabinet", rng.uniform(0.5, 1.2), rng.uniform(0.45, 1.2), rng.uniform(0.2, 0.7)
        leaves = int(rng.integers(1, 3))
    pieces, paint = case(rng, view, w, h, d)
    front, metalwork = front_paint(rng, paint), fitting(rng)
    handles: list[Patch] = []
    style = (
        rng.choice(["bar", "lever", "knob"], p=[0.5, 0.3, 0.2])
        if leaves == 1
        else rng.choice(["bar", "knob"], p=[0.7, 0.3])
    )
    for leaf in range(leaves):
        x0, x1 = -w / 2 + w * leaf / leaves, -w / 2 + w * (leaf + 1) / leaves
        pieces += framed(rng, view, x0 + 0.015, -h / 2 + 0.015, x1 - 0.015, h / 2 - 0.015, 0, front)
        right = leaf == 0 if leaves == 2 else rng.random() < 0.5
        x = x1 - 0.09 if right else x0 + 0.09
        y = rng.uniform(-0.3, 0.3) * h
        if style == "bar":
            if leaves == 1 and rng.random() < 0.25:
                handles += bar_handle(
                    rng, view, 0, h * rng.uniform(0.3, 0.42), w * rng.uniform(0.5, 0.85), 0, False, metalwork
                )
            else:
                handles += bar_handle(rng, view, x, y, h * rng.uniform(0.12, 0.5), 0, True, metalwork)
        elif style == "lever":
            handles += lever_handle(rng, view, x, y, rng.uniform(0.1, 0.24), 0, metalwork)
        else:
            handles += knob(rng, view, x, y, rng.uniform(0.025, 0.055), 0, GRIP, metalwork)
    return DrawnThing(kind, pieces + handles, upright=True)


def appliance(rng: Rng) -> DrawnThing:
    """A microwave, an oven, a stove, a coffee machine: a case with a door, buttons, knobs, a display, a spout."""
    view = any_view(rng)
    coffee = rng.random() < 0.4
    w, h, d = (
        (rng.uniform(0.35, 0.6), rng.uniform(0.6, 1.0), rng.uniform(0.3, 0.6))
        if coffee
        else (rng.uniform(0.8, 1.2), rng.uniform(0.45, 0.8), rng.uniform(0.3, 0.8))
    )
    pieces, paint = case(rng, view, w, h, d)
    control = fitting(rng)
    if coffee:
        hollow = rectangle(-w * 0.35, -h * 0.38, w * 0.35, h * rng.uniform(-0.05, 0.15))
        pieces.append(Patch(on_front(view, hollow, 0.004), BODY, paint.shade(rng.uniform(0.2, 0.6))))
        top = float(hollow[:, 1].max())
        pieces += [
            *cuboid(
                view,
                np.array([-0.06, top - 0.12, 0.0]),
                np.array([0.06, top + 0.02, 0.1]),
                SPOUT,
                fitting(rng),
                0.1,
            )
        ]
        band = (top + 0.06, h / 2 - 0.03)
        across = (-w * 0.4, w * 0.4)
    else:
        side = rng.choice([-1, 1])
        edge = w * rng.uniform(0.2, 0.32) * side
        x0, x1 = (-w / 2 + 0.02, edge) if side > 0 else (edge, w / 2 - 0.02)
        pieces += framed(rng, view, x0, -h / 2 + 0.02, x1, h / 2 - 0.02, 0.0, front_paint(rng, paint))
        if rng.random() < 0.85:
            pieces += bar_handle(rng, view, edge - side * 0.06, 0, h * rng.uniform(0.4, 0.85), 0, True, fitting(rng))
        across = (edge + 0.05 * side, side * w * 0.45)
        band = (-h * 0.4, h * 0.4)
    x0, x1 = min(across), max(across)
    if rng.random() < 0.4:
        pieces.append(
            Patch(
                on_front(view, rectangle(x0, band[1] - (band[1] - band[0]) * 0.3, x1, band[1]), 0.004), BODY, plain(rng)
            )
        )
    rows, columns = int(rng.integers(1, 4)), int(rng.integers(1, 4))
    size = min((x1 - x0) / columns, (band[1] - band[0]) / rows) * rng.uniform(0.25, 0.42)
    is_knob = rng.random() < 0.4
    for y in np.linspace(band[0] + size, band[1] - size, rows) if rows > 1 else [(band[0] + band[1]) / 2]:
        for x in np.linspace(x0 + size, x1 - size, columns) if columns > 1 else [(x0 + x1) / 2]:
            if is_knob:
                pieces += knob(rng, view, x, y, size, 0, CONTROL, control)
            else:
                power = rng.choice([2.0, 8.0])
                pieces += [
                    Patch(
                        on_front(view, ellipse(x, y, size, size * 0.7, power), 0.006 + 0.01 * k),
                        CONTROL,
                        control.shade(0.75 + 0.12 * k),
                    )
                    for k in range(3)
                ]
    return DrawnThing("coffee machine" if coffee else "microwave", pieces, upright=True)


def oven(rng: Rng) -> DrawnThing:
    """An oven, a stove, a washing machine: a row of knobs or buttons above a door with a long handle."""
    view = any_view(rng)
    w, h = rng.uniform(0.7, 1.1), rng.uniform(0.6, 1.2)
    pieces, paint = case(rng, view, w, h, rng.uniform(0.4, 0.8))
    line_y = h * rng.uniform(0.2, 0.38)
    pieces += framed(rng, view, -w / 2 + 0.02, -h / 2 + 0.03, w / 2 - 0.02, line_y - 0.02, 0, front_paint(rng, paint))
    if rng.random() < 0.8:
        pieces += bar_handle(rng, view, 0, line_y - 0.08, w * rng.uniform(0.5, 0.9), 0, False, fitting(rng))
    control, n = fitting(rng), int(rng.integers(1, 7))
    band = h / 2 - line_y
    size = min(band, w / n) * rng.uniform(0.2, 0.36)
    for x in np.linspace(-w * 0.4, w * 0.4, n) if n > 1 else [w * rng.uniform(-0.4, 0.4)]:
        pieces += knob(rng, view, float(x), line_y + band / 2, size, 0, CONTROL, control)
    return DrawnThing("microwave", pieces, upright=True)


def laptop(rng: Rng) -> DrawnThing:
    """A base with keys and a lid with a screen."""
    view = BoxView(np.radians(rng.uniform(-40, 40)), np.radians(rng.uniform(15, 60)), rng.uniform(2.5, 7))
    w, d = rng.uniform(0.8, 1.1), rng.uniform(0.5, 0.75)
    paint = plain(rng).shade(1, relief=0.0, tube=0.0)
    pieces = cuboid(view, np.array([-w / 2, -0.04, -d / 2]), np.array([w / 2, 0.0, d / 2]), BODY, paint, 0.1)
    angle, tall = np.radians(rng.uniform(60, 125)), d * rng.uniform(0.85, 1)
    y, z = tall * np.sin(angle), -d / 2 + tall * np.cos(angle)
    lid = np.array([[-w / 2, 0, -d / 2], [w / 2, 0, -d / 2], [w / 2, y, z], [-w / 2, y, z]])
    middle = lid.mean(0)
    pieces.append(Patch(view(lid), LID, paint.shade(rng.uniform(0.7, 1.1))))
    pieces.append(Patch(view(middle + (lid - middle) * 0.88), LID, plain(rng).shade(rng.uniform(0.3, 1.2), relief=0.0)))
    dark = plain(rng).shade(rng.uniform(0.2, 0.9), relief=0.0)
    x0, x1, z0, z1 = -w * 0.44, w * 0.44, -d * 0.4, d * rng.uniform(0.0, 0.15)
    keys = np.array([[x0, 0, z0], [x1, 0, z0], [x1, 0, z1], [x0, 0, z1]])
    pieces.append(Patch(view(keys), CONTROL, dark))
    key = dark.shade(rng.uniform(0.6, 1.7))
    for z in np.linspace(z0, z1, 6)[:-1]:
        for x in np.linspace(x0, x1, 13)[:-1]:
            a, b = (x1 - x0) / 13, (z1 - z0) / 6
            pieces.append(
                Patch(view(np.array([[x, 0, z], [x + a, 0, z], [x + a, 0, z + b], [x, 0, z + b]])), CONTROL, key)
            )
    return DrawnThing("other", pieces, upright=True)


def switch(rng: Rng) -> DrawnThing:
    """A plate or small case with a button, a rocker, a toggle or a dial."""
    view = any_view(rng)
    w, h = rng.uniform(0.4, 0.9), rng.uniform(0.4, 0.9)
    pieces, _ = case(rng, view, w, h, rng.uniform(0.03, 0.6))
    control = fitting(rng)
    n = int(rng.choice([1, 1, 1, 2]))
    for x in np.linspace(-0.2, 0.2, n) * w if n > 1 else [0.0]:
        pick = rng.random()
        r = min(w, h) * rng.uniform(0.1, 0.4) / n
        if rng.random() < 0.4:
            pieces.append(
                Patch(on_front(view, ellipse(x, 0, r * 1.3, r * 1.3, rng.choice([2, 8])), 0.004), BODY, plain(rng))
            )
        if pick < 0.45:
            pieces += knob(rng, view, x, 0, r, 0, CONTROL, control)
        elif pick < 0.7:
            pieces += cuboid(
                view,
                np.array([x - r * 0.6, -r, 0]),
                np.array([x + r * 0.6, r, rng.uniform(0.02, 0.08)]),
                CONTROL,
                control,
                rng.normal() * 0.2,
            )
        else:
            tip = view(
                np.array(
                    [
                        [x, 0, 0],
                        [x + rng.normal() * 0.05, rng.choice([-1, 1]) * rng.uniform(0.05, 0.3), rng.uniform(0.1, 0.3)],
                    ]
                )
            )
            pieces.append(Patch(strip(line(*tip[0], *tip[1]), rng.uniform(0.04, 0.1)), CONTROL, control))
    return DrawnThing("switch", pieces, upright=True)


def dial(rng: Rng) -> DrawnThing:
    """A knob or dial that fills most of the crop."""
    view = any_view(rng)
    w = rng.uniform(0.5, 1.0)
    pieces, _ = case(rng, view, w, w * rng.uniform(0.8, 1.2), rng.uniform(0.02, 0.3))
    pieces += knob(rng, view, 0, 0, w * rng.uniform(0.2, 0.42), 0, CONTROL, fitting(rng))
    return DrawnThing("knob", pieces, upright=True)


def lever(rng: Rng) -> DrawnThing:
    """A lever on a stand: a press, a pump, a joystick."""
    view = any_view(rng)
    w, h, d = rng.uniform(0.25, 0.6), rng.uniform(0.3, 0.9), rng.uniform(0.2, 0.5)
    pieces, _ = case(rng, view, w, h, d)
    x, y, z = rng.choice([-1, 1]) * w * rng.uniform(0, 0.5), h * rng.uniform(-0.2, 0.45), rng.uniform(-0.1, 0.05)
    direction = rng.normal(size=3) * [1, 1, 0.5]
    direction[2] = abs(direction[2])
    direction /= np.linalg.norm(direction)
    length = rng.uniform(0.35, 0.9)
    start = np.array([x, y, z])
    k = rng.uniform(0.45, 0.8)
    flat = view(np.stack([start, start + direction * length * k, start + direction * length]))
    rod, grip = fitting(rng), plain(rng)
    thin = rng.uniform(0.03, 0.06)
    pieces.append(Patch(strip(line(*flat[0], *flat[1]), thin), BODY, rod))
    if rng.random() < 0.35:
        pieces.append(Patch(ellipse(flat[2, 0], flat[2, 1], thin * 1.8, thin * 1.8), GRIP, grip.shade(1, relief=0.5)))
        pieces.append(Patch(strip(line(*flat[1], *flat[2]), thin), GRIP, rod))
    else:
        pieces.append(Patch(strip(line(*flat[1], *flat[2]), thin * rng.uniform(1.4, 2.8)), GRIP, grip))
    return DrawnThing("lever", pieces, upright=True)


def box(rng: Rng) -> DrawnThing:
    """A box, open, with a lid, or a lid's handle."""
    view = BoxView(np.radians(rng.uniform(-55, 55)), np.radians(rng.uniform(8, 65)), rng.uniform(2.2, 7))
    w, h, d = rng.uniform(0.5, 1.1), rng.uniform(0.2, 0.8), rng.uniform(0.4, 0.9)
    pieces, paint = case(rng, view, w, h, d)
    pick = rng.random()
    if pick < 0.5:
        m = 0.04
        top = np.array(
            [[-w / 2 + m, h / 2, -d + m], [w / 2 - m, h / 2, -d + m], [w / 2 - m, h / 2, -m], [-w / 2 + m, h / 2, -m]]
        )
        pieces.append(Patch(view(top), INSIDE, paint.shade(rng.uniform(0.25, 0.7))))
        if rng.random() < 0.5:
            far = top.copy()
            far[2:, 1] -= h * 0.5
            far[2:, 2] = far[:2, 2]
            pieces.append(Patch(view(far[[0, 1, 2, 3]]), INSIDE, paint.shade(rng.uniform(0.4, 0.9))))
    else:
        lid = paint.shade(rng.uniform(0.8, 1.2)) if rng.random() < 0.6 else plain(rng)
        pieces += cuboid(
            view,
            np.array([-w / 2 - 0.02, h / 2, -d - 0.02]),
            np.array([w / 2 + 0.02, h / 2 + rng.uniform(0.03, 0.15), 0.02]),
            LID,
            lid,
            0.1,
        )
        if rng.random() < 0.6:
            y = h / 2 + 0.1
            ends = view(np.array([[-0.13, y, -d / 2], [0.13, y, -d / 2]]))
            rise = rng.uniform(0.08, 0.2)
            pieces.append(
                Patch(strip(line(*ends[0], *ends[1], bend=-rise), rng.uniform(0.03, 0.06)), GRIP, fitting(rng))
            )
    return DrawnThing("box", pieces, upright=True)


def faucet(rng: Rng) -> DrawnThing:
    paint = metal(rng) if rng.random() < 0.7 else plain(rng)
    paint = paint.shade(1, tube=rng.uniform(0.2, 0.8))
    h, thick = rng.uniform(0.3, 1.0), rng.uniform(0.07, 0.17)
    side = rng.choice([-1, 1])
    pieces = [
        Patch(ellipse(0, 0, thick * rng.uniform(0.8, 1.6), thick * 0.5), BODY, paint),
        Patch(strip(line(0, 0, 0, -h), thick), BODY, paint),
    ]
    reach = rng.uniform(0.3, 0.8)
    if rng.random() < 0.5:
        t = np.linspace(np.pi, rng.uniform(-0.3, 0.6), 30)
        path = np.stack([side * (reach / 2 + reach / 2 * np.cos(t)), -h - reach * rng.uniform(0.3, 0.6) * np.sin(t)], 1)
    else:
        path = np.concatenate(
            [
                line(0, -h * 0.85, side * reach, -h * rng.uniform(0.8, 1.1)),
                line(side * reach, -h * 0.9, side * reach, -h * rng.uniform(0.65, 0.85)),
            ]
        )
    pieces.append(Patch(strip(path, thick * rng.uniform(0.6, 0.95)), SPOUT, paint))
    grip = paint if rng.random() < 0.5 else plain(rng)
    pick = rng.random()
    if pick < 0.55:  # one lever
        angle = np.radians(rng.uniform(-170, -10))
        x, y = 0.0, -h * rng.uniform(0.95, 1.05)
        end = rng.uniform(0.2, 0.5)
        pieces.append(
            Patch(
                strip(
                    line(x, y, x + end * np.cos(angle), y + end * np.sin(angle)),
                    np.linspace(thick * 0.8, thick * rng.uniform(0.3, 0.8), 32),
                ),
                GRIP,
                grip,
            )
        )
    else:  # knobs on both sides
        for s in (-1, 1):
            x = s * rng.uniform(0.18, 0.3)
            pieces.append(Patch(strip(line(0, -h * 0.3, x, -h * 0.3), thick * 0.5), BODY, paint))
            pieces.append(
                Patch(
                    ellipse(x, -h * 0.3, thick * rng.uniform(0.6, 1), thick * rng.uniform(0.6, 1), rng.uniform(2, 4)),
                    GRIP,
                    grip,
                )
            )
    return DrawnThing("faucet", pieces, upright=True)


def lamp(rng: Rng) -> DrawnThing:
    h = rng.uniform(0.6, 1.2)
    base, shade = fitting(rng), plain(rng)
    r0, r1, hs = rng.uniform(0.1, 0.3), rng.uniform(0.25, 0.45), rng.uniform(0.2, 0.5)
    pieces = [
        Patch(ellipse(0, 0, rng.uniform(0.15, 0.3), rng.uniform(0.03, 0.12)), BODY, base),
        Patch(strip(line(0, 0, 0, -h), widths(rng, 0.05, 0.05, 0.4)), BODY, base),
        Patch(
            np.array([[-r1, -h + hs * 0.3], [-r0, -h - hs * 0.7], [r0, -h - hs * 0.7], [r1, -h + hs * 0.3]]),
            LID,
            shade.shade(rng.uniform(1, 1.4), tube=0.3),
        ),
    ]
    return DrawnThing("lamp", pieces, upright=True)


FIXTURES: dict[Callable[[Rng], DrawnThing], float] = {
    drawers: 1.3, doors: 1.7, appliance: 1.2, oven: 0.7, laptop: 0.4, switch: 1.0, dial: 0.5, lever: 0.7, box: 0.8,
    faucet: 0.9, lamp: 0.4,
}  # fmt: skip
"""Each maker and how often it is drawn."""
