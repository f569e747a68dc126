"""Look at a simulator set: its samples on one sheet, with the truth drawn.

    python perf/sim_sheet.py --data DIR [--out sheet.jpg] [--limit 40] [--columns 8] [--tile 240]

The outline of each region, its box and its point are drawn; above stands what was said, below the object,
the affordance and how much of the part is seen.
"""

from __future__ import annotations

import argparse
import itertools
import json
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw
from scipy.ndimage import binary_dilation

COLOURS = ((255, 40, 40), (0, 190, 255), (255, 210, 0), (210, 80, 255))
CAPTION = 30


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--data", type=Path, required=True, help="a set that `a4 data make sim` wrote")
    parser.add_argument("--out", type=Path, default=Path("sheet.jpg"))
    parser.add_argument("--limit", type=int, default=40)
    parser.add_argument("--columns", type=int, default=8)
    parser.add_argument("--tile", type=int, default=240, help="side of a sample in pixels")
    arguments = parser.parse_args()

    lines = (arguments.data / "samples.jsonl").read_text(encoding="utf-8").splitlines()[: arguments.limit]
    tile, columns = arguments.tile, arguments.columns
    height = tile + CAPTION
    sheet = Image.new("RGB", (columns * tile, -(-len(lines) // columns) * height), "white")
    for index, text in enumerate(lines):
        row = json.loads(text)
        picture = drawn(arguments.data, row, tile)
        left, top = index % columns * tile, index // columns * height
        sheet.paste(picture, (left + (tile - picture.width) // 2, top + CAPTION + (tile - picture.height) // 2))
        said = textwrap.fill(row["instruction"], tile // 6)
        below = f"{row['object_name']}, {row['affordance']}, {row['visible_share']:.0%} seen"
        draw = ImageDraw.Draw(sheet)
        draw.multiline_text((left + 3, top + 1), said, fill="black", spacing=1)
        draw.text((left + 3, top + height - 12), below, fill="black", stroke_width=2, stroke_fill="white")
    sheet.save(arguments.out, quality=80)
    print(arguments.out)


def drawn(root: Path, row: dict[str, Any], side: int) -> Image.Image:
    """The picture of a sample with its truth, at most `side` pixels wide and high."""
    with Image.open(root / row["image"]) as file:
        pixels = np.array(file)
    with Image.open(root / row["regions"]) as file:
        regions = np.array(file)
    for number, colour in zip(row["region_numbers"], itertools.cycle(COLOURS), strict=False):
        region = regions == number
        pixels[binary_dilation(region, iterations=3) & ~region] = colour
    picture = Image.fromarray(pixels)
    draw = ImageDraw.Draw(picture)
    for box in row["boxes_xyxy"]:
        draw.rectangle([box[0], box[1], box[2] - 1, box[3] - 1], outline=(60, 255, 60), width=2)
    for x, y in row["points_xy"]:
        draw.ellipse([x - 6, y - 6, x + 6, y + 6], fill="white", outline="black", width=2)
    picture.thumbnail((side, side))
    return picture


if __name__ == "__main__":
    main()
