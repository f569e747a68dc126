"""One drawing: a thing where a proposal would have cropped it, or no thing at all.

draw(np.random.default_rng(3)) -> Drawing(image (176, 176, 3) uint8 RGB, parts (176, 176) uint8, kind "knife")
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from a4agent.offline.training import canvas
from a4agent.offline.training.fixtures import FIXTURES
from a4agent.offline.training.grounds import marker, sheet, texture
from a4agent.offline.training.pieces import DrawnThing, Patch, Rng, blob, ellipse, line, plain, rectangle, strip
from a4agent.offline.training.solids import any_view, cuboid
from a4agent.offline.training.tools import TOOLS
from a4agent.offline.training.vessels import VESSELS
from a4agent.offline.vocabulary import BODY, NOTHING

EMPTY = 0.15
"""The share of drawings that show no thing."""
LEAST_CONTRAST = 24.0
FAMILIES: tuple[tuple[dict[Callable[[Rng], DrawnThing], float], float], ...] = (
    (TOOLS, 0.5),
    (VESSELS, 0.22),
    (FIXTURES, 0.28),
)


@dataclass(frozen=True, eq=False)
class Drawing:
    """`image` (SIDE, SIDE, 3) uint8 RGB, `parts` (SIDE, SIDE) uint8 labels, `kind` of the thing in the middle."""

    image: np.ndarray
    parts: np.ndarray
    kind: str


def any_thing(rng: Rng) -> DrawnThing:
    makers, _ = FAMILIES[rng.choice(len(FAMILIES), p=[share for _, share in FAMILIES])]
    weights = np.array(list(makers.values()))
    return list(makers)[rng.choice(len(weights), p=weights / weights.sum())](rng)


def draw(rng: Rng) -> Drawing:
    """A random drawing, in which the thing can be told from its ground."""
    while True:
        image, parts, kind = _draw_once(rng)
        if kind == "none" or _contrast(image, parts) > LEAST_CONTRAST or rng.random() < 0.1:
            return Drawing(*canvas.expose(rng, image, parts), kind)


def _contrast(image: np.ndarray, parts: np.ndarray) -> float:
    """How far the thing's pixels are from those right around it, in grey levels."""
    shown = (parts > 0).astype(np.uint8)
    around = cv2.dilate(shown, np.ones((15, 15), np.uint8)) > shown
    if not around.any() or not shown.any():
        return 255.0
    return float(np.abs(image[shown > 0] - image[around].mean(0)).mean())


def _draw_once(rng: Rng) -> tuple[np.ndarray, np.ndarray, str]:
    image, parts = canvas.new_canvas(rng)
    light = rng.uniform(0, 2 * np.pi)
    if rng.random() < EMPTY:
        _draw_nothing(rng, image, light)
        kind = "none"
    else:
        thing = any_thing(rng)
        kind = thing.kind
        if rng.random() < 0.25:
            _draw_neighbours(rng, image, light)
        loose = rng.random()
        fill = (
            rng.uniform(0.55, 0.9) if loose < 0.7 else rng.uniform(0.2, 0.6) if loose < 0.92 else rng.uniform(0.9, 1.3)
        )
        spread = 0.045 if fill > 0.55 else 0.12
        x, y = 0.5 + rng.normal(0, spread if fill < 1 else 0.12, 2)
        at = canvas.place(rng, thing, fill, (float(x), float(y)))
        canvas.paint_thing(rng, image, parts, thing, at, light)
        if rng.random() < 0.3:
            canvas.outline_faint(rng, image, thing, at)
        if rng.random() < 0.05:
            _cover(rng, image, parts)
    return image, parts, kind


def _draw_neighbours(rng: Rng, image: np.ndarray, light: float) -> None:
    """Other things near the border, which are background here."""
    for _ in range(int(rng.integers(1, 3))):
        other = any_thing(rng) if rng.random() < 0.6 else _plain_thing(rng)
        angle = rng.uniform(0, 2 * np.pi)
        x, y = 0.5 + np.array([np.cos(angle), np.sin(angle)]) * rng.uniform(0.48, 0.62)
        at = canvas.place(rng, other, rng.uniform(0.15, 0.5), (float(x), float(y)))
        canvas.paint_thing(rng, image, np.zeros(image.shape[:2], np.uint8), other, at, light)


def _cover(rng: Rng, image: np.ndarray, parts: np.ndarray) -> None:
    """Something in front hides a little of it."""
    size = canvas.FINE
    x, y = rng.uniform(0.2, 0.8, 2) * size
    outline = blob(rng, x, y, rng.uniform(0.05, 0.12) * size)
    points = [np.round(outline).astype(np.int32)]
    mask = np.zeros((size, size), np.uint8)
    cv2.fillPoly(mask, points, 1)
    image[mask > 0] = texture(rng, size)[mask > 0]
    parts[mask > 0] = NOTHING


def _plain_thing(rng: Rng) -> DrawnThing:
    """A block, a ball, a coin, fruit, a toy: a thing without parts that one would ask for."""
    pick = rng.random()
    if pick < 0.3:
        outline = ellipse(0, 0, 0.5, rng.uniform(0.3, 0.5), rng.uniform(2, 3), rng.uniform(-0.2, 0.2))
        pieces = [Patch(outline, BODY, plain(rng).shade(1, relief=rng.uniform(0, 1)))]
        if rng.random() < 0.3:
            pieces.append(Patch(ellipse(0, 0, 0.35, 0.25), BODY, plain(rng)))
    elif pick < 0.55:
        view = any_view(rng)
        pieces = cuboid(
            view, -rng.uniform(0.2, 0.6, 3), rng.uniform(0.2, 0.6, 3), BODY, plain(rng), rng.normal() * 0.15
        )
    elif pick < 0.8:  # an animal or a toy: blobs with limbs
        skin = plain(rng)
        pieces = [
            Patch(
                strip(line(*(rng.normal(size=2) * 0.2), *(rng.normal(size=2) * 0.5)), rng.uniform(0.05, 0.15)),
                BODY,
                skin,
            )
            for _ in range(rng.integers(2, 6))
        ]
        pieces.append(Patch(blob(rng, 0, 0, 0.35), BODY, skin))
        pieces.append(Patch(blob(rng, 0.35, -0.2, 0.2), BODY, skin))
        for _ in range(rng.integers(0, 4)):
            x, y = rng.normal(size=2) * 0.15 + [0.35, -0.2]
            pieces.append(Patch(ellipse(x, y, 0.03, 0.03), BODY, plain(rng)))
    else:
        pieces = [Patch(blob(rng, 0, 0, 0.4), BODY, plain(rng))]
    return DrawnThing("none", pieces)


def _draw_nothing(rng: Rng, image: np.ndarray, light: float) -> None:
    """Textures, text, plants, cards, markers, plain things: all background."""
    size = canvas.FINE
    unused = np.zeros((size, size), np.uint8)
    pick = rng.random()
    if pick < 0.2:
        for _ in range(int(rng.integers(1, 3))):
            x, y = 0.5 + rng.normal(0, 0.06, 2)
            draw_flat = marker if rng.random() < 0.5 else sheet
            draw_flat(rng, image, (float(x), float(y)), rng.uniform(0.1, 0.4))
    elif pick < 0.5:
        for _ in range(int(rng.integers(1, 4))):
            thing = _plain_thing(rng)
            at = canvas.place(rng, thing, rng.uniform(0.3, 0.9), tuple(rng.uniform(0.3, 0.7, 2)))  # pyright: ignore[reportArgumentType]
            canvas.paint_thing(rng, image, unused, thing, at, light)
    elif pick < 0.63:  # text
        for y in np.arange(rng.uniform(10, 40), size, rng.uniform(14, 50)):
            letters = "".join(chr(rng.integers(65, 122)) for _ in range(20))
            colour = tuple(float(v) for v in rng.uniform(0, 255, 3))
            written = np.zeros(image.shape[:2], np.uint8)  # OpenCV 5 writes on bytes only
            cv2.putText(
                written,
                letters,
                (int(rng.integers(-20, 40)), int(y)),
                int(rng.integers(0, 7)),
                rng.uniform(0.4, 1.5),
                (255,),
                int(rng.integers(1, 4)),
                cv2.LINE_AA,
            )
            image += (written.astype(np.float32) / 255)[..., None] * (np.array(colour, np.float32) - image)
    elif pick < 0.75:  # leaves
        green = plain(rng).shade(1)
        leaves = [
            Patch(
                strip(
                    line(0, 0, rng.normal(), rng.normal(), rng.normal() * 0.2),
                    0.16 * np.sin(np.linspace(0.05, 3.1, 32)),
                ),
                BODY,
                green.shade(rng.uniform(0.6, 1.4)),
            )
            for _ in range(rng.integers(3, 14))
        ]
        thing = DrawnThing("none", leaves)
        canvas.paint_thing(
            rng, image, unused, thing, canvas.place(rng, thing, rng.uniform(0.6, 1.2), (0.5, 0.5)), light
        )
    elif pick < 0.85:  # a building, a landscape: bands and rectangles
        for _ in range(int(rng.integers(4, 20))):
            x, y = rng.uniform(-0.1, 1, 2) * size
            thing = DrawnThing(
                "none",
                [Patch(rectangle(x, y, x + rng.uniform(5, 120), y + rng.uniform(5, 120)), BODY, plain(rng))],
            )
            canvas.paint_thing(rng, image, unused, thing, canvas.Placed(np.eye(2), np.zeros(2)), light)
    # else the ground alone
