"""Masks as COCO run-length encoding: `{"size": [height, width], "counts": "..."}`, JSON-safe."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from a4agent.errors import DataError

Rle = dict[str, Any]
MAX_PIXELS = 100_000_000


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
            raise ValueError("a run of fewer than no pixels")
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
        raise ValueError("a character that stands for no run")
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
