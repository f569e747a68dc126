"""Draws a thing on a ground as a camera would see it: shading, sheen, cast shadow, blur, noise, JPEG."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from a4agent.imaging.load import read_pixels
from a4agent.offline.training.grounds import ground, noise
from a4agent.offline.training.pieces import DrawnThing, Paint, Rng

SIDE = 176
"""Pixels of a finished drawing; training crops 160 of them."""
FINE = 280
"""Pixels of the canvas it is drawn on."""
SHIFT = 4


@dataclass(frozen=True, eq=False)
class Placed:
    """`matrix` (2, 2) and `offset` (2,) from the thing's units to canvas pixels."""

    matrix: np.ndarray
    offset: np.ndarray

    def __call__(self, outline: np.ndarray) -> np.ndarray:
        return outline @ self.matrix.T + self.offset


def place(rng: Rng, thing: DrawnThing, fill: float, center_xy: tuple[float, float]) -> Placed:
    """Turned, slanted and scaled so that its longer side takes `fill` of the canvas, at `center_xy` (shares)."""
    angle = rng.normal() * rng.choice([0.1, 0.4]) if thing.upright else rng.uniform(0, 2 * np.pi)
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.array([[c, -s], [s, c]])
    if not thing.upright and rng.random() < 0.7:  # seen at a slant
        matrix = np.diag([1, rng.uniform(0.5, 1)]) @ matrix
    if rng.random() < 0.5:
        matrix = matrix @ np.diag([1, -1]) if not thing.upright else matrix @ np.diag([-1, 1])
    points = np.concatenate([piece.outline for piece in thing.pieces if piece.part]) @ matrix.T
    low, high = points.min(0), points.max(0)
    scale = fill * FINE / float((high - low).max())
    return Placed(matrix * scale, np.array(center_xy) * FINE - (low + high) / 2 * scale)


def _mask(outline: np.ndarray) -> tuple[np.ndarray, slice, slice] | None:
    """Coverage 0..1 within the outline's window of the canvas, and the window."""
    low = np.floor(outline.min(0)).astype(int) - 2
    high = np.ceil(outline.max(0)).astype(int) + 3
    x0, y0 = np.maximum(low, 0)
    x1, y1 = np.minimum(high, FINE)
    if x1 <= x0 or y1 <= y0:
        return None
    mask = np.zeros((y1 - y0, x1 - x0), np.uint8)
    points = np.round((outline - [x0, y0]) * (1 << SHIFT)).astype(np.int32)
    cv2.fillPoly(mask, [points], 255, cv2.LINE_AA, SHIFT)
    return mask, slice(y0, y1), slice(x0, x1)


def _shaded(rng: Rng, paint: Paint, mask: np.ndarray, light: float, outline: np.ndarray) -> np.ndarray:
    """The look of a piece in its window (h, w, 3) float32."""
    height, width = mask.shape
    value = np.ones((height, width), np.float32)
    depth = cv2.distanceTransform((mask > 127).astype(np.uint8), cv2.DIST_L2, 3)
    depth /= max(float(depth.max()), 1e-3)
    if paint.relief:
        value += 0.6 * paint.relief * (np.minimum(depth, 0.6) - 0.4)
    if paint.tube or paint.bands:
        spread = outline - outline.mean(0)
        _, _, axes = np.linalg.svd(spread, full_matrices=False)
        yy, xx = np.mgrid[:height, :width].astype(np.float32)
        center = np.array([width / 2, height / 2])
        if paint.tube:
            across = axes[1] if np.ptp(spread @ axes[0]) > 1.6 * np.ptp(spread @ axes[1]) else np.array([1.0, 0.0])
            reach = max(float(np.abs(spread @ across).max()), 1.0)
            u = ((xx - center[0]) * across[0] + (yy - center[1]) * across[1]) / reach
            value += paint.tube * 0.55 * (0.35 - (u - 0.8 * np.sin(light)) ** 2)
        if paint.bands:
            turn = rng.uniform(0, np.pi)
            along = np.array([np.cos(turn), np.sin(turn)])
            reach = max(float(np.abs(spread @ along).max()), 1.0)
            u = ((xx - center[0]) * along[0] + (yy - center[1]) * along[1]) / reach
            value += paint.bands * np.cos(u * rng.uniform(1, 6) + rng.uniform(0, 6))
    look = paint.colour.astype(np.float32) * np.clip(value, 0.05, 1.9)[..., None]
    if paint.grain:
        look += noise(rng, height, width, rng.uniform(0, 0.7))[..., None] * paint.grain
    if paint.gloss > 0:
        at = rng.uniform(0.15, 0.95)
        shine = np.exp(-(((depth - at) / rng.uniform(0.06, 0.3)) ** 2)) * np.clip(
            noise(rng, height, width, rng.uniform(0.5, 1)) * 0.7 + 0.3, 0, 1
        )
        look += (shine * paint.gloss * 130)[..., None]
    return look


def paint_thing(rng: Rng, image: np.ndarray, parts: np.ndarray, thing: DrawnThing, at: Placed, light: float) -> None:
    """Draw a thing with its shadow over `image` (FINE, FINE, 3) and its labels into `parts`."""
    shapes = [(piece, at(piece.outline)) for piece in thing.pieces]
    if rng.random() < 0.8:
        shadow = np.zeros((FINE, FINE), np.uint8)
        reach = np.array([np.cos(light), np.sin(light)]) * rng.uniform(0, 0.07) * FINE
        for piece, outline in shapes:
            colour = 255 if piece.paint else 0
            cv2.fillPoly(
                shadow, [np.round((outline + reach) * (1 << SHIFT)).astype(np.int32)], colour, cv2.LINE_AA, SHIFT
            )
        soft = cv2.GaussianBlur(shadow, (0, 0), rng.uniform(1, 12)).astype(np.float32) * (rng.uniform(0.1, 0.65) / 255)
        image *= 1 - soft[..., None]
    behind = image.copy() if any(piece.paint is None for piece in thing.pieces) else None
    for piece, outline in shapes:
        if (window := _mask(outline)) is None:
            continue
        mask, rows, columns = window
        solid = mask > 127
        if not solid.any():
            continue
        alpha = (mask.astype(np.float32) / 255)[..., None]
        if piece.paint is None:
            assert behind is not None
            look = behind[rows, columns]
        else:
            look = _shaded(rng, piece.paint, mask, light, outline)
        image[rows, columns] += alpha * (look - image[rows, columns])
        parts[rows, columns][solid] = piece.part


def outline_faint(rng: Rng, image: np.ndarray, thing: DrawnThing, at: Placed) -> None:
    """Dark or bright creases where pieces meet."""
    strength = rng.uniform(0.5, 1.25)
    for piece in thing.pieces:
        if piece.part and rng.random() < 0.5:
            line = np.zeros((FINE, FINE), np.uint8)
            cv2.polylines(
                line, [np.round(at(piece.outline) * (1 << SHIFT)).astype(np.int32)], True, 255, 1, cv2.LINE_AA, SHIFT
            )
            image *= (1 + (strength - 1) * (line.astype(np.float32) / 255))[..., None]


def expose(rng: Rng, image: np.ndarray, parts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A photograph (SIDE, SIDE, 3) uint8 of the canvas, and its labels (SIDE, SIDE) uint8.

    Half of them are taken from afar, so that the crop is a small, blurred, blocky one that was enlarged.
    """
    yy, xx = np.mgrid[:FINE, :FINE].astype(np.float32) / FINE - 0.5
    slope = rng.uniform(-0.5, 0.5, 2)
    image = image * ((1 + slope[0] * xx + slope[1] * yy) * rng.uniform(0.6, 1.25))[..., None]
    if rng.random() < 0.5:
        image = image * (1 + rng.normal(size=3) * 0.06).astype(np.float32)
    side = int(rng.uniform(34, SIDE)) if rng.random() < 0.55 else SIDE
    image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.5, 1.4) * FINE / side / 1.7)
    image = cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA)
    if rng.random() < 0.12:
        length = int(rng.integers(2, 5))
        kernel = np.zeros((length, length), np.float32)
        cv2.line(kernel, (0, int(rng.integers(0, length))), (length - 1, int(rng.integers(0, length))), 1.0)
        image = cv2.filter2D(image, -1, kernel / max(float(kernel.sum()), 1e-3))
    contrast = rng.uniform(0.6, 1.15)
    image = (image - 128) * contrast + 128 + rng.normal() * 10
    image = image + rng.normal(0, rng.uniform(0, 9), image.shape)
    if rng.random() < 0.25:
        blurred = cv2.GaussianBlur(image, (0, 0), 1.2)
        image = image + (image - blurred) * rng.uniform(0.3, 1.5)
    photograph = np.clip(image, 0, 255).astype(np.uint8)
    if rng.random() < 0.6:
        packed = cv2.imencode(".jpg", photograph[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(35, 96))])[1]
        photograph = read_pixels(packed.tobytes())
    if side != SIDE:
        photograph = np.asarray(cv2.resize(photograph, (SIDE, SIDE), interpolation=cv2.INTER_LINEAR), np.uint8)
    return photograph, np.asarray(cv2.resize(parts, (SIDE, SIDE), interpolation=cv2.INTER_NEAREST), np.uint8)


def new_canvas(rng: Rng) -> tuple[np.ndarray, np.ndarray]:
    return ground(rng, FINE), np.zeros((FINE, FINE), np.uint8)
