"""A picture of the answer: the mask tinted with a clean outline, the box, the key points, the phrase.

Everything is drawn light over a dark halo, so that it reads on bright and on dark photographs alike. A guess that
was not accepted is hatched instead of tinted.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Protocol, cast

import numpy as np
from PIL import Image as Pillow
from PIL import ImageChops, ImageDraw, ImageFilter, ImageFont
from PIL.Image import Image

from a4agent.imaging.load import load_image

Font = ImageFont.FreeTypeFont | ImageFont.ImageFont
ACCENTS = ((255, 61, 127), (0, 188, 212), (255, 179, 0), (124, 92, 255), (0, 200, 120))
DARK = (16, 18, 24)
LIGHT = (255, 255, 255)
SHORTEST, LONGEST = 640, 1600
LONGEST_CAPTION = 300
"""In characters."""
FONTS = (
    "NotoSans-Regular.ttf",
    "DejaVuSans.ttf",
    "NotoSansCJK-Regular.ttc",
    "wqy-zenhei.ttc",
    "DroidSansFallbackFull.ttf",
    "Arial Unicode.ttf",
    "msyh.ttc",
    "malgun.ttf",
    "arial.ttf",
)
"""Fonts for scripts other than Latin on Linux, macOS and Windows, by file name."""


class Marked(Protocol):
    """What can be drawn: a box (4,) xyxy or None, points (k, 2) and a mask (H, W) of bool; a `types.Region`."""

    @property
    def box_xyxy(self) -> np.ndarray | None: ...
    @property
    def points_xy(self) -> np.ndarray: ...
    @property
    def mask(self) -> np.ndarray: ...


def draw(
    image: Image | np.ndarray,
    regions: Sequence[Marked],
    *,
    caption: str | None = None,
    opacity: float = 0.5,
    hatched: bool = False,
) -> Image:
    """The photograph with the regions over it; scaled so that its longer side has 640 to 1600 pixels.

    `opacity` of the tint is 0 to 1; `caption` is a line of text below, None for no line; `hatched` draws the masks as
    stripes, for an answer that is unsure.
    """
    photo = load_image(image, max_pixels=sys.maxsize)  # it is in memory already, so no limit applies
    scale = np.clip(max(photo.size), SHORTEST, LONGEST) / max(photo.size)
    size = (max(round(photo.width * scale), 1), max(round(photo.height * scale), 1))
    stroke = max(round(max(size) / 480), 1)
    canvas = photo.resize(size, Pillow.Resampling.LANCZOS) if size != photo.size else photo.copy()
    masks = [region.mask for region in regions if region.mask.any()]
    if masks:
        canvas = _dim_outside(canvas, np.logical_or.reduce(masks))
    for number, region in enumerate(regions):
        accent = ACCENTS[number % len(ACCENTS)]
        canvas = _tint(canvas, region.mask, accent, opacity, stroke, hatched)
    for number, region in enumerate(regions):
        accent = ACCENTS[number % len(ACCENTS)]
        if region.box_xyxy is not None:
            _draw_box(canvas, region.box_xyxy * scale, accent, stroke)
        _draw_points(canvas, (region.points_xy + 0.5) * scale, accent, stroke)
    return canvas if caption is None else _caption(canvas, caption, stroke)


def _soft(mask: np.ndarray, size: tuple[int, int]) -> Image:
    """The mask as a smooth 8-bit picture of `size`."""
    soft = Pillow.fromarray(mask.astype(np.uint8) * 255).resize(size, Pillow.Resampling.BICUBIC)
    return soft.filter(ImageFilter.GaussianBlur(max(size) / 1000))


def _dim_outside(canvas: Image, mask: np.ndarray) -> Image:
    dimmed = Pillow.blend(canvas, Pillow.new("RGB", canvas.size, DARK), 0.28)
    return Pillow.composite(canvas, dimmed, _soft(mask, canvas.size))


def _tint(
    canvas: Image, mask: np.ndarray, accent: tuple[int, int, int], opacity: float, stroke: int, hatched: bool
) -> Image:
    soft = _soft(mask, canvas.size)
    tint = soft.point([round(value * opacity) for value in range(256)])
    if hatched:
        tint = ImageChops.multiply(tint, _stripes(canvas.size, 4 * stroke))
    tinted = Pillow.composite(Pillow.new("RGB", canvas.size, accent), canvas, tint)
    hard = soft.point([255 * (value > 127) for value in range(256)])
    inner = hard.filter(ImageFilter.MinFilter(2 * stroke + 1))
    outer = hard.filter(ImageFilter.MaxFilter(2 * stroke + 1))
    halo = outer.filter(ImageFilter.MaxFilter(2 * ((stroke + 1) // 2) + 1))

    def ring(outside: Image, inside: Image) -> Image:
        band = np.asarray(outside, np.int16) - np.asarray(inside, np.int16)
        return Pillow.fromarray(np.clip(band, 0, 255).astype(np.uint8)).filter(ImageFilter.GaussianBlur(0.6))

    tinted = Pillow.composite(Pillow.new("RGB", canvas.size, DARK), tinted, ring(halo, outer))
    tinted = Pillow.composite(Pillow.new("RGB", canvas.size, LIGHT), tinted, ring(outer, hard))
    return Pillow.composite(Pillow.new("RGB", canvas.size, accent), tinted, ring(hard, inner))


def _stripes(size: tuple[int, int], width: int) -> Image:
    """Diagonal stripes as an 8-bit picture: `width` pixels on, twice as many off."""
    rows, columns = np.ogrid[: size[1], : size[0]]
    return Pillow.fromarray((((rows + columns) % (3 * width) < width) * 255).astype(np.uint8))


def _draw_box(canvas: Image, box_xyxy: np.ndarray, accent: tuple[int, int, int], stroke: int) -> None:
    pen = ImageDraw.Draw(canvas)
    x0, y0, x1, y1 = (float(edge) for edge in box_xyxy)
    x1, y1 = max(x1 - 1, x0), max(y1 - 1, y0)
    pen.rounded_rectangle((x0, y0, x1, y1), radius=3 * stroke, outline=DARK, width=2 * stroke + 1)
    inset = (stroke + 1) / 2
    if x1 - x0 > 2 * inset and y1 - y0 > 2 * inset:
        frame = (x0 + inset, y0 + inset, x1 - inset, y1 - inset)
        pen.rounded_rectangle(frame, radius=3 * stroke, outline=LIGHT, width=stroke)


def _draw_points(canvas: Image, points_xy: np.ndarray, accent: tuple[int, int, int], stroke: int) -> None:
    pen = ImageDraw.Draw(canvas)
    for x, y in points_xy:
        for radius, colour in ((6 * stroke, DARK), (5 * stroke, LIGHT), (3 * stroke, accent)):
            pen.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)


def _caption(canvas: Image, text: str, stroke: int) -> Image:
    size = max(round(max(canvas.size) / 36), 13)
    font, text = _font(" ".join(text.split())[:LONGEST_CAPTION], size)
    pad, margin = round(size * 0.55), round(size * 0.6)
    room = canvas.width - 2 * (pad + margin)
    while len(text) > 1 and font.getlength(text) > room:
        text = text[:-2].rstrip() + "…"
    if canvas.height < 3 * size or font.getlength(text) > room:
        return canvas
    left, top, right, bottom = font.getbbox(text)
    height, y = bottom - top, canvas.height - margin - 2 * pad - (bottom - top)
    pill = Pillow.new("L", canvas.size, 0)
    ImageDraw.Draw(pill).rounded_rectangle(
        (margin, y, margin + 2 * pad + right - left, y + 2 * pad + height), radius=pad, fill=200
    )
    canvas = Pillow.composite(Pillow.new("RGB", canvas.size, DARK), canvas, pill)
    ImageDraw.Draw(canvas).text((margin + pad - left, y + pad - top), text, font=font, fill=LIGHT)
    return canvas


def _font(text: str, size: int) -> tuple[Font, str]:
    """The font that draws most of a text, and the text with an ellipsis for what that one cannot draw.

    Pillow's own font for Latin text; for other scripts whatever the system has.
    """
    font: Font = ImageFont.load_default(size)
    lacking = _lacking(font, text)
    for name in FONTS:
        other = _of_system(name, size) if lacking else None
        if other is not None and len(fewer := _lacking(other, text)) < len(lacking):
            font, lacking = other, fewer
    return font, re.sub(f"[{re.escape(''.join(lacking))}]+", "…", text) if lacking else text


@lru_cache(maxsize=32)
def _of_system(name: str, size: int) -> Font | None:
    try:
        return ImageFont.truetype(name, size)
    except OSError:
        return None


def _lacking(font: Font, text: str) -> set[str]:
    """The characters of a text for which a font has no shape."""

    def shape(letter: str) -> bytes:
        return bytes(cast(Any, font.getmask(letter)))

    nothing = shape("\U0010ffff")
    return {letter for letter in set(text) if not letter.isspace() and shape(letter) == nothing}
