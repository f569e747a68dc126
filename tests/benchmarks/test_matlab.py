"""MATLAB's files: what scipy writes is read back, and forged ones are refused."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from a4agent.benchmarks import matlab
from a4agent.errors import DataError

scipy_io: Any = pytest.importorskip("scipy.io")


def element(kind: int, data: bytes) -> bytes:
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def compressed(content: bytes) -> bytes:
    packed = zlib.compress(content)
    return b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM" + struct.pack("<II", 15, len(packed)) + packed


def cells(depth: int) -> bytes:
    """gt_label as a cell within a cell within a cell, ..."""
    levels: list[bytes] = []
    size = 0
    for level in range(depth):
        name = b"gt_label" if level == depth - 1 else b""
        head = element(6, struct.pack("<II", 1, 0)) + element(5, struct.pack("<II", 1, 1)) + element(1, name)
        size += len(head)
        levels.append(struct.pack("<II", 14, size) + head)
        size += 8
    return b"".join(reversed(levels))


def refusal(path: Path, content: bytes) -> str:
    path.write_bytes(content)
    with pytest.raises(DataError, match="is not a MATLAB file with 'gt_label'") as caught:
        matlab.read_array(path, "gt_label")
    return str(caught.value)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("dtype", ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8", "?"])
def test_numbers_of_every_kind_are_read(tmp_path: Path, packed: bool, dtype: str) -> None:
    path = tmp_path / "label_rank.mat"
    ranks = (np.arange(2 * 3 * 7).reshape(2, 3, 7) % 5).astype(dtype)
    others = {"a": 1, "b": {"c": [1, "text"]}, "s": "gt_label", "gt_label": ranks, "z": np.array([{}], object)}
    scipy_io.savemat(path, others, do_compression=packed)
    found = matlab.read_array(path, "gt_label")
    assert found.shape == (2, 3, 7)
    assert np.array_equal(found, ranks)
    assert matlab.read_array(path, "a").tolist() == [[1]]


def test_the_other_byte_order_is_read(tmp_path: Path) -> None:
    path = tmp_path / "label_rank.mat"
    parts = [
        (6, struct.pack(">II", 9, 0)),
        (5, struct.pack(">II", 1, 2)),
        (1, b"gt_label"),
        (3, struct.pack(">hh", 1, 300)),
    ]
    content = b"".join(struct.pack(">II", kind, len(data)) + data + bytes(-len(data) % 8) for kind, data in parts)
    path.write_bytes(b"MATLAB 5.0".ljust(124) + b"\1\0MI" + struct.pack(">II", 14, len(content)) + content)
    assert matlab.read_array(path, "gt_label").tolist() == [[1, 300]]


def test_a_forged_matlab_file_is_refused_before_it_is_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "label_rank.mat"
    assert "no array of numbers" in refusal(path, compressed(cells(100_000)))  # which crash scipy
    assert "version 5" in refusal(path, bytes(200))
    with monkeypatch.context() as small:
        small.setattr(matlab, "MAX_BYTES", 1_000_000)
        assert "unpacks to 1000000 bytes or more" in refusal(path, compressed(bytes(2_000_000)))
        assert "more than 1000000 bytes" in refusal(path, compressed(b"")[:128] + bytes(1_000_000))
    with pytest.raises(DataError, match="no such file"):
        matlab.read_array(tmp_path / "none.mat", "gt_label")


@pytest.mark.parametrize("wrong", [np.full((2, 2), np.nan), np.full((2, 2), 1j), np.array(["text"]), {"a": 1}])
def test_what_is_not_finite_numbers_is_refused(tmp_path: Path, wrong: Any) -> None:
    path = tmp_path / "label_rank.mat"
    scipy_io.savemat(path, {"gt_label": wrong})
    refusal(path, path.read_bytes())


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(where=st.integers(124, 330), byte=st.integers(0, 255), cut=st.integers(0, 330))
def test_a_damaged_file_is_an_array_or_our_error(tmp_path: Path, where: int, byte: int, cut: int) -> None:
    path = tmp_path / "label_rank.mat"
    scipy_io.savemat(path, {"gt_label": np.ones((2, 3, 7), np.uint8)})
    raw = bytearray(path.read_bytes())
    raw[min(where, len(raw) - 1)] = byte
    for content in (bytes(raw), bytes(raw[: 128 + cut])):
        path.write_bytes(content)
        try:
            matlab.read_array(path, "gt_label")
        except DataError as error:
            assert "is not a MATLAB file" in str(error)
