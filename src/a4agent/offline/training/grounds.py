"""What things lie on and stand before: tables, boards with edges, cloth, paper, markers, walls, clutter."""

from __future__ import annotations

import functools

import cv2
import numpy as np

from a4agent.offline.training.pieces import Rng, any_colour, blob, ellipse, rotate, wood

NOISES = 24
PLAIN = 0.4
"""The share of grounds of one colour."""


@functools.cache
def _bank() -> np.ndarray:
    """Smooth noise of several scales to cut textures from, (NOISES, 512, 512) float32 of deviation 1."""
    rng = np.random.default_rng(7)
    bank = np.empty((NOISES, 512, 512), np.float32)
    for index in range(NOISES):
        scale = 1.5 * 1.28**index
        k = max(3, int(512 / scale))
        field = cv2.resize(rng.normal(size=(k, k)).astype(np.float32), (512, 512), interpolation=cv2.INTER_CUBIC)
        bank[index] = field / field.std()
    return bank


def noise(rng: Rng, height: int, width: int, coarse: float) -> np.ndarray:
    """Noise (height, width) float32 of deviation about 1; `coarse` 0 (fine) to 1."""
    field = _bank()[min(int(coarse * NOISES), NOISES - 1)]
    if rng.random() < 0.5:
        field = field.T
    y, x = rng.integers(0, 513 - height), rng.integers(0, 513 - width)
    return field[y : y + height, x : x + width]


def texture(rng: Rng, size: int) -> np.ndarray:
    """A surface (size, size, 3) float32."""
    pick = rng.random()
    base = any_colour(rng).astype(np.float32)
    image = np.empty((size, size, 3), np.float32)
    image[:] = base
    image += noise(rng, size, size, rng.uniform(0.6, 1))[..., None] * rng.uniform(0, 14)
    if pick < 0.3:
        pass
    elif pick < 0.5:  # wood: noise drawn out along one direction
        image[:] = wood(rng)
        stretch = int(rng.integers(6, 30))
        field = noise(rng, size, size, rng.uniform(0, 0.45))[: max(size // stretch, 4)]
        grain = cv2.resize(np.ascontiguousarray(field), (size, size), interpolation=cv2.INTER_LINEAR)
        image += (grain.T if rng.random() < 0.5 else grain)[..., None] * rng.uniform(4, 26)
        if rng.random() < 0.4:
            for x in np.linspace(0, size, rng.integers(3, 7))[1:-1].astype(int):
                image[:, x : x + 2] *= rng.uniform(0.4, 0.9)
    elif pick < 0.65:  # granite, carpet, grass
        for _ in range(2):
            image += noise(rng, size, size, rng.uniform(0, 0.4))[..., None] * rng.normal(size=3) * rng.uniform(3, 26)
    elif pick < 0.78:  # tiles, checks, stripes
        period = rng.uniform(10, 80)
        yy, xx = np.mgrid[:size, :size].astype(np.float32)
        a = rng.uniform(0, np.pi)
        u, v = xx * np.cos(a) + yy * np.sin(a), -xx * np.sin(a) + yy * np.cos(a)
        other = any_colour(rng).astype(np.float32)
        style = rng.random()
        if style < 0.35:
            on = (np.floor(u / period) + np.floor(v / period)) % 2 > 0
        elif style < 0.7:
            on = u % period < period * rng.uniform(0.05, 0.5)
        else:
            on = (u % period < 2.5) | (v % period < 2.5)
        image[on] = image[on] * 0.3 + other * 0.7 if rng.random() < 0.5 else other
    elif pick < 0.9:  # blotches of a few colours
        field = noise(rng, size, size, rng.uniform(0.3, 0.9))
        for level in rng.uniform(-1, 1, rng.integers(1, 4)):
            image[field > level] = any_colour(rng) * 0.6 + base * 0.4
    image += noise(rng, size, size, rng.uniform(0, 0.25))[..., None] * rng.uniform(0, 9)
    return image


def _fill(image: np.ndarray, outline: np.ndarray, colour: np.ndarray) -> None:
    cv2.fillPoly(image, [np.round(outline * 8).astype(np.int32)], tuple(float(v) for v in colour), cv2.LINE_AA, 3)


def _quad(rng: Rng, size: int, half: float, x: float, y: float) -> np.ndarray:
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float) * half * [rng.uniform(0.6, 1.5), 1]
    corners = rotate(corners * rng.uniform(0.85, 1.15, (4, 2)), rng.uniform(0, 360))
    return (corners + np.array([x, y])) * size


def ground(rng: Rng, size: int) -> np.ndarray:
    """A background (size, size, 3) float32 RGB."""
    if rng.random() < PLAIN:
        image = np.empty((size, size, 3), np.float32)
        image[:] = any_colour(rng)
        return image + noise(rng, size, size, rng.uniform(0, 1))[..., None] * rng.uniform(0, 8)
    image = texture(rng, size)
    pick = rng.random()
    if pick < 0.22:  # an edge: table and floor, wall and table
        other = texture(rng, size)
        a, d = rng.uniform(0, 2 * np.pi), rng.uniform(-0.45, 0.45) * size
        yy, xx = np.mgrid[:size, :size] - size / 2
        far = xx * np.cos(a) + yy * np.sin(a) > d
        image[far] = other[far]
        if rng.random() < 0.4:
            rim = np.abs(xx * np.cos(a) + yy * np.sin(a) - d) < rng.uniform(1, 7)
            image[rim] = any_colour(rng)
    elif pick < 0.5:  # a board, a cutting board, a sheet of paper, a tray
        other = texture(rng, size) if rng.random() < 0.6 else None
        quad = _quad(rng, size, rng.uniform(0.25, 0.6), *rng.uniform(0.35, 0.65, 2))
        if rng.random() < 0.15:
            quad = (
                ellipse(rng.uniform(0.4, 0.6), rng.uniform(0.4, 0.6), rng.uniform(0.3, 0.7), rng.uniform(0.3, 0.7))
                * size
            )
        _lay(rng, image, quad, other)
        if rng.random() < 0.5:
            cv2.polylines(
                image,
                [np.round(quad).astype(np.int32)],
                True,
                tuple(float(v) for v in any_colour(rng)),
                int(rng.integers(1, 9)),
                cv2.LINE_AA,
            )
    if rng.random() < 0.22:
        _markers(rng, image, size)
    for _ in range(int(rng.choice([0, 0, 0, 1, 2, 4]))):
        _clutter(rng, image, size)
    return image


def _markers(rng: Rng, image: np.ndarray, size: int) -> None:
    """Square black-and-white markers or a checkerboard near the border."""
    for _ in range(int(rng.integers(1, 4))):
        angle = rng.uniform(0, 2 * np.pi)
        x, y = 0.5 + np.array([np.cos(angle), np.sin(angle)]) * rng.uniform(0.38, 0.6)
        marker(rng, image, (float(x), float(y)), rng.uniform(0.04, 0.16))


def marker(rng: Rng, image: np.ndarray, center_xy: tuple[float, float], half: float) -> None:
    """A slanted black-and-white marker of random cells; its centre and half side are shares of the picture."""
    size, turn, n = len(image), rng.uniform(0, 360), int(rng.integers(2, 7))
    cells = rng.random((n, n)) < 0.5
    shape = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    slant = np.array([[1, rng.normal() * 0.2], [0, rng.uniform(0.6, 1)]])

    def put(outline: np.ndarray, colour: float) -> None:
        _fill(image, (rotate(outline, turn) @ slant * half + center_xy) * size, np.full(3, colour))

    put(shape * 1.25, rng.uniform(190, 255))
    put(shape, rng.uniform(0, 50))
    for row, column in np.argwhere(cells):
        put(shape / n * 0.98 + (np.array([column, row]) + 0.5) / n * 2 - 1, 235.0)


def sheet(rng: Rng, image: np.ndarray, center_xy: tuple[float, float], half: float) -> None:
    """A blank or printed card, a sheet of paper, a board: a flat thing that is no thing to act on."""
    size = len(image)
    quad = _quad(rng, size, half, *center_xy)
    _lay(rng, image, quad, texture(rng, size) if rng.random() < 0.4 else None)


def _lay(rng: Rng, image: np.ndarray, outline: np.ndarray, look: np.ndarray | None) -> None:
    """Cover an outline (n, 2) with a texture of the picture's size, or with any colour."""
    mask = np.zeros(image.shape[:2], np.uint8)
    cv2.fillPoly(mask, [np.round(outline).astype(np.int32)], 1)
    image[mask > 0] = look[mask > 0] if look is not None else any_colour(rng)


def _clutter(rng: Rng, image: np.ndarray, size: int) -> None:
    """A line, a cable, a patch, a coin near the border."""
    angle = rng.uniform(0, 2 * np.pi)
    x, y = (0.5 + np.array([np.cos(angle), np.sin(angle)]) * rng.uniform(0.36, 0.62)) * size
    colour = tuple(float(v) for v in any_colour(rng))
    pick = rng.random()
    if pick < 0.3:
        cv2.line(
            image,
            (int(x), int(y)),
            tuple(int(v) for v in rng.uniform(-0.2, 1.2, 2) * size),
            colour,
            int(rng.integers(1, 6)),
            cv2.LINE_AA,
        )
    elif pick < 0.5:
        path = np.cumsum(rng.normal(size=(12, 2)) * size * 0.05, 0) + np.array([x, y])
        cv2.polylines(image, [np.round(path).astype(np.int32)], False, colour, int(rng.integers(1, 5)), cv2.LINE_AA)
    elif pick < 0.8:
        _fill(image, blob(rng, x, y, rng.uniform(0.03, 0.16) * size), np.array(colour))
    else:
        _fill(image, _quad(rng, size, rng.uniform(0.03, 0.15), x / size, y / size), np.array(colour))
