"""Pictures drawn for these tests: a tool or a vessel on a plain table, with the masks of its parts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from PIL import Image, ImageDraw, ImageFilter

pytest.importorskip("cv2", reason="the extra 'offline' is not installed")
pytest.importorskip("onnxruntime", reason="the extra 'offline' is not installed")

Paint = Callable[[ImageDraw.ImageDraw, ImageDraw.ImageDraw | None], None]


@dataclass(frozen=True)
class Drawing:
    """`image` RGB; `parts` name -> (H, W) bool; "whole" is their union."""

    image: Image.Image
    parts: dict[str, np.ndarray]


def _compose(
    shapes: list[tuple[str, str, list[tuple[float, float]], tuple[int, int, int]]],
    size: tuple[int, int],
    table: tuple[int, int, int],
    degrees: float,
) -> Drawing:
    """Shapes ("polygon" | "ellipse" | "ring", part, points, colour), turned, blurred a little and made grainy."""
    fine = 2
    picture = Image.new("RGB", (size[0] * fine, size[1] * fine), table)
    masks: dict[str, Image.Image] = {}
    for kind, part, points, colour in shapes:
        scaled = [(x * fine, y * fine) for x, y in points]
        mask = masks.setdefault(part, Image.new("L", picture.size, 0))
        if kind == "polygon":
            ImageDraw.Draw(picture).polygon(scaled, fill=colour)
            ImageDraw.Draw(mask).polygon(scaled, fill=255)
        elif kind == "ellipse":
            ImageDraw.Draw(picture).ellipse(scaled, fill=colour)
            ImageDraw.Draw(mask).ellipse(scaled, fill=255)
        else:
            ImageDraw.Draw(picture).ellipse(scaled, outline=colour, width=14 * fine)
            ImageDraw.Draw(mask).ellipse(scaled, outline=255, width=14 * fine)
    picture = picture.rotate(degrees, Image.Resampling.BICUBIC, fillcolor=table)
    picture = picture.filter(ImageFilter.GaussianBlur(1.0)).resize(size, Image.Resampling.LANCZOS)
    grain = np.random.default_rng(0).normal(0, 2.5, (size[1], size[0], 3))
    image = Image.fromarray(np.clip(np.asarray(picture) + grain, 0, 255).astype(np.uint8))
    parts = {
        part: np.asarray(mask.rotate(degrees).resize(size, Image.Resampling.BILINEAR)) > 127
        for part, mask in masks.items()
    }
    return Drawing(image, {**parts, "whole": np.logical_or.reduce(list(parts.values()))})


@pytest.fixture(scope="session")
def screwdriver() -> Callable[..., Drawing]:
    """A red handle and a thin grey shaft."""

    def draw(degrees: float = 20, table: tuple[int, int, int] = (205, 200, 190), size: tuple[int, int] = (480, 360)):
        handle = [(110, 160), (230, 160), (235, 170), (235, 190), (230, 200), (110, 200), (100, 190), (100, 170)]
        shaft = [(235, 173), (370, 173), (370, 187), (235, 187)]
        shapes = [("polygon", "shaft", shaft, (120, 122, 128)), ("polygon", "handle", handle, (190, 30, 35))]
        return _compose(shapes, size, table, degrees)

    return draw


@pytest.fixture(scope="session")
def spoon() -> Callable[..., Drawing]:
    """One material: a thin handle and an oval bowl."""

    def draw(degrees: float = -30, table: tuple[int, int, int] = (40, 44, 46), size: tuple[int, int] = (480, 360)):
        handle = [(100, 172), (300, 174), (300, 186), (100, 190)]
        shapes = [
            ("polygon", "handle", handle, (210, 208, 205)),
            ("ellipse", "bowl", [(295, 150), (385, 210)], (222, 220, 216)),
        ]
        return _compose(shapes, size, table, degrees)

    return draw


@pytest.fixture(scope="session")
def mug() -> Callable[..., Drawing]:
    """A white body with a dark inside, and a ring for a handle, half of it behind the body."""

    def draw(degrees: float = 0, table: tuple[int, int, int] = (45, 60, 120), size: tuple[int, int] = (480, 360)):
        shapes = [
            ("ring", "handle", [(255, 130), (345, 240)], (225, 222, 215)),
            ("polygon", "body", [(150, 110), (290, 110), (280, 270), (160, 270)], (232, 230, 224)),
            ("ellipse", "body", [(150, 90), (290, 130)], (170, 168, 160)),
            ("ellipse", "body", [(160, 255), (280, 285)], (226, 224, 218)),
        ]
        drawing = _compose(shapes, size, table, degrees)
        drawing.parts["handle"] &= ~drawing.parts["body"]
        return drawing

    return draw


@pytest.fixture(scope="session")
def pan() -> Callable[..., Drawing]:
    """A grey disc in a dark wall, with a long handle."""

    def draw(degrees: float = 15, table: tuple[int, int, int] = (214, 205, 190), size: tuple[int, int] = (480, 360)):
        shapes = [
            ("polygon", "handle", [(265, 172), (400, 172), (400, 190), (265, 190)], (70, 45, 30)),
            ("ellipse", "wall", [(100, 95), (270, 265)], (38, 38, 42)),
            ("ellipse", "pan", [(110, 105), (260, 255)], (92, 92, 98)),
        ]
        drawing = _compose(shapes, size, table, degrees)
        drawing.parts["handle"] &= ~drawing.parts["wall"]
        return drawing

    return draw


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


@pytest.fixture(scope="session")
def overlap() -> Callable[[np.ndarray, np.ndarray], float]:
    """Intersection over union of two masks."""
    return iou
