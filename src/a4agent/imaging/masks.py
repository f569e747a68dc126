"""Masks (H, W) of bool and boxes xyxy: a mask's box and deepest point, overlaps, and COCO run-length encoding.

encode_rle(mask) -> {"size": [height, width], "counts": "..."}        JSON-safe
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from a4agent.errors import DataError
from a4agent.imaging.load import MAX_PIXELS

Rle = dict[str, Any]


def tight_box(mask: np.ndarray) -> np.ndarray | None:
    """The box xyxy (4,) float32 around a mask's pixels, half-open; None for a blank mask."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return None
    return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], np.float32)


def deepest_point(mask: np.ndarray) -> np.ndarray | None:
    """The centre xy (2,) float32 of the pixel farthest from the mask's border; None for a blank mask.

    The picture's edge counts as border.
    """
    from scipy.ndimage import distance_transform_edt

    box = tight_box(mask)
    if box is None:
        return None
    x0, y0, x1, y1 = (int(edge) for edge in box)
    depth: Any = distance_transform_edt(np.pad(mask[y0:y1, x0:x1], 1))
    row, column = np.unravel_index(int(depth.argmax()), depth.shape)
    return np.array([x0 + column - 0.5, y0 + row - 0.5], np.float32)  # less the padding, plus half a pixel


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two masks; 1 if both are blank."""
    union = int((a | b).sum())
    return int((a & b).sum()) / union if union else 1.0


def box_area(boxes_xyxy: np.ndarray) -> Any:
    """The areas (...) of boxes (..., 4)."""
    return (boxes_xyxy[..., 2:] - boxes_xyxy[..., :2]).prod(-1)


def box_overlap(a: np.ndarray, b: np.ndarray) -> Any:
    """The areas (...) that boxes (..., 4) share."""
    low, high = np.maximum(a[..., :2], b[..., :2]), np.minimum(a[..., 2:], b[..., 2:])
    return np.maximum(high - low, 0).prod(-1)


def box_iou(a: np.ndarray, b: np.ndarray) -> Any:
    """Intersection over union (...) of boxes (..., 4); 0 if both are empty."""
    shared = box_overlap(a, b)
    return shared / np.maximum(box_area(a) + box_area(b) - shared, 1e-9)


def encode_rle(mask: np.ndarray) -> Rle:
    """A mask (H, W) of bool as compressed COCO RLE with `counts` as str."""
    from pycocotools import mask as coco  # pyright: ignore[reportMissingTypeStubs]

    height, width = mask.shape
    if not mask.size:
        return {"size": [int(height), int(width)], "counts": ""}
    packed: Any = coco.encode(np.asfortranarray(mask, dtype=np.uint8))
    return {"size": [int(height), int(width)], "counts": packed["counts"].decode("ascii")}


def decode_rle(rle: Mapping[str, Any]) -> np.ndarray:
    """The mask (H, W) of bool that `rle` describes; counts may be str, bytes or a plain list.

    Raises:
        DataError: the value is not a COCO RLE of a sane size, or its runs do not add up to that size.
    """
    try:
        height, width = (int(side) for side in rle["size"])
        counts = rle["counts"]
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DataError(f"not a COCO RLE, which has 'size' [h, w] and 'counts': {str(rle)[:80]!r}") from error
    if height < 0 or width < 0 or height * width > MAX_PIXELS:
        raise DataError(f"a COCO RLE of impossible size {height} x {width}")
    try:
        runs = np.array(counts, np.int64) if isinstance(counts, list) else _runs(counts)
        if runs.ndim != 1 or (runs < 0).any():
            raise ValueError("a negative run")
    except (ValueError, TypeError, OverflowError, UnicodeError) as error:
        raise DataError(f"a COCO RLE that cannot be decoded ({error})") from error
    if int(runs.sum()) != height * width:
        raise DataError(f"a COCO RLE of {height} x {width} pixels whose runs add up to {int(runs.sum())}")
    columns = np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(width, height)
    return np.ascontiguousarray(columns.T)


def _runs(text: str | bytes) -> np.ndarray:
    """The lengths of the runs in COCO's compressed text: five bits a character, low first, as steps from two before.

    Format: pycocotools, `common/maskApi.c`, rleFrString. Read here because that decoder leaves the pixels after the
    last run undefined.
    """
    raw = text.encode("ascii") if isinstance(text, str) else bytes(text)
    digits = np.frombuffer(raw, np.uint8).astype(np.int64) - 48
    if not len(digits):
        return np.zeros(0, np.int64)
    if digits.min() < 0 or digits.max() > 63 or digits[-1] & 32:
        raise ValueError("an invalid character")
    ends = np.flatnonzero(digits & 32 == 0)
    starts = np.concatenate([[0], ends[:-1] + 1])
    lengths = ends - starts + 1
    if lengths.max() > 7:
        raise ValueError("a run longer than any picture")
    places = np.arange(len(digits)) - np.repeat(starts, lengths)
    values = np.add.reduceat((digits & 31) << (5 * places), starts)
    values -= np.where(digits[ends] & 16, np.int64(1) << (5 * lengths), 0)
    for first in (1, 2):
        values[first::2] = np.cumsum(values[first::2])
    return values
