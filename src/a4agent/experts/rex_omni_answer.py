"""What Rex-Omni is asked and how its answers are read: plain strings and numbers, no framework.

    detection_prompt("the handle of the mug")
        -> "Detect the handle of the mug. Output the bounding box coordinates in [x0, y0, x1, y1] format."
    read_answer("<|object_ref_start|>mug<|object_ref_end|><|box_start|><10><20><30><40>,<5><9><|box_end|>", (999, 999))
        -> [("mug", "box", [10.0, 20.0, 30.0, 40.0]), ("mug", "point", [5.0, 9.0])]

An answer names a phrase, then its shapes, separated by commas: two coordinate tokens are a point, four a
box, more (an even number) a polygon; `None` stands for nothing found. Each coordinate is one of a thousand
bins: pixel = bin / 999 * side of the original image. Nothing is clipped or ordered.

Source: model card of IDEA-Research/Rex-Omni (the prompts are the ones it was trained on).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Literal

import numpy as np

from a4agent.experts.coordinates import BINS_999, to_pixels

SYSTEM = "You are a helpful assistant"  # no full stop: so it was trained
MAX_NEW_TOKENS = 4096
REPETITION_PENALTY = 1.05
MIN_PIXELS, MAX_PIXELS = 16 * 28 * 28, 2560 * 28 * 28

FIRST_COORDINATE_ID = 150643  # <0>; <999> is 151642
SPECIAL_IDS = {
    "<|endoftext|>": 151643,
    "<|im_start|>": 151644,
    "<|im_end|>": 151645,
    "<|object_ref_start|>": 151646,
    "<|object_ref_end|>": 151647,
    "<|box_start|>": 151648,
    "<|box_end|>": 151649,
    "<|vision_start|>": 151652,
    "<|vision_end|>": 151653,
    "<|image_pad|>": 151655,
}

Kind = Literal["point", "box", "polygon"]
Shape = tuple[str, Kind, list[float]]
"""(phrase, kind, flat coordinates x, y, x, y ... in pixels of the original image)."""

_Piece = str | int  # a special token or plain text, or the number of a coordinate token
_TOKEN = re.compile(r"(<\|[a-z_]+\|>)|<(\d{1,9})>")


def detection_prompt(*categories: str) -> str:
    """The question that is answered with boxes."""
    return f"Detect {_listed(categories)}. Output the bounding box coordinates in [x0, y0, x1, y1] format."


def pointing_prompt(*categories: str) -> str:
    """The question that is answered with points."""
    return f"Point to {_listed(categories)}."


def _listed(categories: Sequence[str]) -> str:
    # The comma separates categories, so training data held none inside; underscores had become spaces.
    return ", ".join(" ".join(c.replace(",", " ").replace("_", " ").split()) for c in categories)


def read_answer(text: str, size_wh: tuple[int, int]) -> list[Shape]:
    """The shapes in the text of an answer (special tokens kept), in the order they were given.

    What cannot be read is left out: an odd number of coordinates, shapes of no phrase. The last
    `<|box_end|>` may be missing. "Found nothing" and free text are an empty list.
    """
    return _shapes(_pieces_of_text(text), size_wh)


def read_tokens(
    ids: Iterable[int],
    size_wh: tuple[int, int],
    decode: Callable[[list[int]], str],
    *,
    first_coordinate: int = FIRST_COORDINATE_ID,
    special_ids: dict[str, int] = SPECIAL_IDS,
) -> list[Shape]:
    """The shapes in the token ids of an answer; like `read_answer`, without trusting a tokenizer's spelling of numbers.

    Args:
        ids: the generated ids.
        size_wh: width and height of the original image in pixels.
        decode: turns the ids of ordinary words into text.
        first_coordinate: the id of `<0>`.
        special_ids: the ids of the special tokens by name.
    """
    return _shapes(_pieces_of_tokens(ids, decode, first_coordinate, special_ids), size_wh)


def boxes_and_points(shapes: Iterable[Shape]) -> tuple[np.ndarray, np.ndarray]:
    """(n, 4) boxes and (m, 2) points, float32; a polygon counts as the box around it."""
    boxes: list[list[float]] = []
    points: list[list[float]] = []
    for _, kind, flat in shapes:
        if kind == "point":
            points.append(flat)
        elif kind == "box":
            boxes.append(flat)
        else:
            xs, ys = flat[0::2], flat[1::2]
            boxes.append([min(xs), min(ys), max(xs), max(ys)])
    return np.array(boxes, np.float32).reshape(-1, 4), np.array(points, np.float32).reshape(-1, 2)


def _pieces_of_text(text: str) -> Iterator[_Piece]:
    end = 0
    for found in _TOKEN.finditer(text):
        if found.start() > end:
            yield text[end : found.start()]
        yield found[1] or int(found[2])
        end = found.end()
    if end < len(text):
        yield text[end:]


def _pieces_of_tokens(
    ids: Iterable[int], decode: Callable[[list[int]], str], first_coordinate: int, special_ids: dict[str, int]
) -> Iterator[_Piece]:
    names = {number: name for name, number in special_ids.items()}
    words: list[int] = []
    for token in ids:
        coordinate = token - first_coordinate
        is_coordinate = 0 <= coordinate <= 999
        if not is_coordinate and token not in names:
            words.append(token)
            continue
        if words:
            yield decode(words)
            words = []
        yield coordinate if is_coordinate else names[token]
    if words:
        yield decode(words)


def _shapes(pieces: Iterable[_Piece], size_wh: tuple[int, int]) -> list[Shape]:
    shapes: list[Shape] = []
    phrase = ""
    numbers: list[int] = []
    inside: Literal["", "phrase", "shapes"] = ""

    def close() -> None:
        if phrase and numbers and len(numbers) % 2 == 0:
            kind: Kind = "point" if len(numbers) == 2 else "box" if len(numbers) == 4 else "polygon"
            shapes.append((phrase, kind, to_pixels(numbers, BINS_999, size_wh).tolist()))
        numbers.clear()

    for piece in pieces:
        if isinstance(piece, int):
            if inside == "shapes":
                numbers.append(piece)
        elif piece.startswith("<|"):
            close()
            inside = "phrase" if piece == "<|object_ref_start|>" else "shapes" if piece == "<|box_start|>" else ""
            if piece in ("<|object_ref_start|>", "<|box_end|>"):
                phrase = ""
            phrase = phrase.strip()
        elif inside == "phrase":
            phrase += piece
        elif inside == "shapes" and "," in piece:
            close()
    close()
    return shapes
