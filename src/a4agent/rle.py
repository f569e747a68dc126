"""Masks as COCO run-length encoding: `{"size": [height, width], "counts": "..."}`, JSON-safe."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from a4agent.errors import DataError

Rle = dict[str, Any]


def encode(mask: np.ndarray) -> Rle:
    """A mask (H, W) of bool as compressed COCO RLE with `counts` as str."""
    from pycocotools import mask as coco  # pyright: ignore[reportMissingTypeStubs]

    height, width = mask.shape
    if not mask.size:
        return {"size": [int(height), int(width)], "counts": ""}
    packed: Any = coco.encode(np.asfortranarray(mask, dtype=np.uint8))
    return {"size": [int(height), int(width)], "counts": packed["counts"].decode("ascii")}


def decode(rle: Mapping[str, Any]) -> np.ndarray:
    """The mask (H, W) of bool that `rle` describes; counts may be str, bytes or a plain list.

    Raises:
        DataError: the value is not a COCO RLE of a sane size.
    """
    from pycocotools import mask as coco  # pyright: ignore[reportMissingTypeStubs]

    try:
        height, width = (int(side) for side in rle["size"])
        counts = rle["counts"]
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"not a COCO RLE, which has 'size' [h, w] and 'counts': {str(rle)[:80]!r}") from error
    if height < 0 or width < 0 or height * width > 2**31:
        raise DataError(f"a COCO RLE of impossible size {height} x {width}")
    if height * width == 0:
        return np.zeros((height, width), dtype=bool)
    try:
        if isinstance(counts, list):
            plain: Any = {"size": [height, width], "counts": counts}
            packed: Any = coco.frPyObjects(plain, height, width)
        else:
            if not isinstance(counts, str | bytes):
                raise TypeError(f"counts are text or a list, not {type(counts).__name__}")
            raw = counts.encode("ascii") if isinstance(counts, str) else counts
            packed = {"size": [height, width], "counts": raw}
        if int(coco.area(packed)) > height * width:
            raise ValueError("it counts more pixels than it has")
        mask: Any = coco.decode(packed)
    except (ValueError, TypeError, UnicodeError) as error:
        raise DataError(f"a COCO RLE that cannot be decoded ({error})") from error
    return mask.astype(bool)
