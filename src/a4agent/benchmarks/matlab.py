"""Arrays of numbers in MATLAB's files of version 5, read without trusting a byte.

    MATLAB 5.0 MAT-file, ...                               128 bytes, the last two the byte order: IM or MI
    element 15: a compressed element, or element 14: a matrix
        element 6: class and flags; element 5: its size; element 1: its name; then the numbers, by columns

An element is a number for its kind, its length in bytes, and its content padded to eight. scipy's reader has no limits
and crashes on forged files, so this reads what data sets need: real numbers by name.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from a4agent.errors import DataError

MAX_BYTES = 200_000_000
"""Of a file, packed and unpacked."""
MATRIX, COMPRESSED = 14, 15
NUMBER_CLASSES = range(6, 16)
COMPLEX = 0x800
DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""By the kind of element. MATLAB keeps numbers in the smallest that holds them, whatever the array's class."""


def read_array(path: Path, name: str) -> np.ndarray:
    """The array of finite real numbers called `name`.

    Raises:
        DataError: no such file or array, a damaged or too large file, or one of another version.
    """
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
        return _find(raw, name.encode())
    except FileNotFoundError as error:
        raise DataError(f"no such file: {str(path)!r}") from error
    except (OSError, ValueError, struct.error, zlib.error) as error:
        raise DataError(f"{str(path)!r} is not a MATLAB file with {name!r}: {error}") from error


def _find(raw: bytes, name: bytes) -> np.ndarray:
    order = {b"IM": "<", b"MI": ">"}.get(raw[126:128])
    if order is None:
        raise ValueError("it is not of MATLAB's version 5")
    if len(raw) > MAX_BYTES:
        raise ValueError(f"it has more than {MAX_BYTES} bytes")
    for kind, content in _elements(raw[128:], order, padded=False):
        if kind == COMPRESSED:
            unpacked = zlib.decompressobj().decompress(content, MAX_BYTES)
            if len(unpacked) == MAX_BYTES:
                raise ValueError(f"it unpacks to {MAX_BYTES} bytes or more")
            kind, content = next(_elements(unpacked, order), (0, b""))
        if kind == MATRIX:
            array = _array(content, order, name)
            if array is not None:
                return array
    raise ValueError("it has no array of numbers of that name")


def _elements(data: bytes, order: str, padded: bool = True) -> Iterator[tuple[int, bytes]]:
    """(kind, content) of each element; up to four bytes of content may stand in the place of their length."""
    start = 0
    while start < len(data):
        (kind,) = struct.unpack_from(f"{order}I", data, start)
        if kind >> 16:
            kind, length, begin, end = kind & 0xFFFF, kind >> 16, start + 4, start + 8
        else:
            (length,) = struct.unpack_from(f"{order}I", data, start + 4)
            begin = start + 8
            end = begin + length + (-length % 8 if padded else 0)
        content = data[begin : begin + length]
        if len(content) < length or begin + length > end:
            raise ValueError("it is cut off")
        yield kind, content
        start = end


def _array(content: bytes, order: str, name: bytes) -> np.ndarray | None:
    """The matrix, if it is one of real numbers with this name."""
    elements = _elements(content, order)
    _, flags = next(elements, (0, b""))
    (flag,) = struct.unpack_from(f"{order}I", flags)
    if flag & 0xFF not in NUMBER_CLASSES:
        return None
    _, sizes = next(elements, (0, b""))
    _, called = next(elements, (0, b""))
    if called != name:
        return None
    kind, numbers = next(elements, (0, b""))
    if flag & COMPLEX or kind not in DTYPES:
        raise ValueError("its numbers are not real")
    shape = [int(size) for size in np.frombuffer(sizes, f"{order}i4")]
    array = np.frombuffer(numbers, order + DTYPES[kind])
    if min(shape, default=0) < 0 or math.prod(shape) != array.size:
        raise ValueError(f"it has {array.size} numbers for an array of {shape}")
    if not np.isfinite(array).all():
        raise ValueError("its numbers are not finite")
    return array.reshape(shape, order="F")
