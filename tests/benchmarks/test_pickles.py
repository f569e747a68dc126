"""A pickle of plain data is read; anything that names another class is refused before it can run."""

from __future__ import annotations

import collections
import contextlib
import io
import pickle
import pickletools
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from a4agent.benchmarks import pickles
from a4agent.errors import DataError

PLAIN = [{"frame_path": "./data/x.jpg", "n": 3, "f": 0.5, "b": b"raw", "none": None, "t": (1, True)}]


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_plain_data_is_read_in_every_protocol(tmp_path: Path, protocol: int) -> None:
    later = ("b",) if protocol < 3 else ()  # bytes: earlier protocols build them by calls
    plain = [{key: value for key, value in PLAIN[0].items() if key not in later}]
    (tmp_path / "x.pkl").write_bytes(pickle.dumps(plain, protocol=protocol))

    assert pickles.load(tmp_path / "x.pkl") == plain


@pytest.mark.parametrize("value", [np.arange(3), np.float32(0.5), {1, 2}, collections.OrderedDict(a=1), 1j])
@pytest.mark.parametrize("protocol", [2, pickle.HIGHEST_PROTOCOL])
def test_other_values_are_refused(tmp_path: Path, value: Any, protocol: int) -> None:
    """Also arrays: numpy's own way to rebuild one takes any shape for any bytes, which corrupts memory."""
    (tmp_path / "x.pkl").write_bytes(pickle.dumps([value], protocol=protocol))
    with pytest.raises(DataError, match="only lists, dicts, texts and numbers"):
        pickles.load(tmp_path / "x.pkl")


def nested(depth: int) -> Any:
    value: Any = "end"
    for _ in range(depth):
        value = [value]
    return value


def sharing(doublings: int) -> Any:
    value: Any = ("a",)
    for _ in range(doublings):
        value = (value, value)
    return value


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (nested(200), "nested more than"),
        (sharing(60), "nested more than"),
        ([1 << 65], "66 bits"),
        ([10**5000], "bits"),
    ],
)
def test_values_that_take_too_long_are_refused_at_once(tmp_path: Path, value: Any, words: str) -> None:
    (tmp_path / "x.pkl").write_bytes(pickle.dumps(value))
    with pytest.raises(DataError, match=words):
        pickles.load(tmp_path / "x.pkl")


@pytest.mark.parametrize("raw", [b"]r\xff\xff\xff\x7f.", b"]p9999999999\n.", b"L" + b"9" * 100_000 + b"L\n."])
def test_small_files_take_little_memory(tmp_path: Path, raw: bytes) -> None:
    """A memo slot of 2^31 would be allocated by the unpickler; the same for what a number's text asks for."""
    (tmp_path / "x.pkl").write_bytes(raw)
    with pytest.raises(DataError):
        pickles.load(tmp_path / "x.pkl")


def test_a_large_file_is_not_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "x.pkl").write_bytes(pickle.dumps(["x" * 100]))
    monkeypatch.setattr(pickles, "MAX_BYTES", 50)
    with pytest.raises(DataError, match="over the limit"):
        pickles.load(tmp_path / "x.pkl")


class Touch:
    """Runs a program when it is unpickled."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> Any:
        return (subprocess.call, (["touch", str(self.target)],))


def test_a_malicious_pickle_is_refused_by_name_and_does_not_run(tmp_path: Path) -> None:
    (tmp_path / "x.pkl").write_bytes(pickle.dumps([{"question": Touch(tmp_path / "ran")}]))

    with pytest.raises(DataError, match=r"subprocess\.call"):
        pickles.load(tmp_path / "x.pkl")

    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("os", "system"),
        ("posix", "system"),
        ("builtins", "eval"),
        ("builtins", "getattr"),
        ("builtins", "__import__"),
        ("numpy", "load"),
        ("numpy", "ndarray.__reduce__"),
        ("numpy.core.multiarray", "frombuffer"),
        ("numpy.testing._private.utils", "runstring"),
        ("collections", "namedtuple"),
        ("_codecs", "decode"),
        ("copyreg", "_reconstructor"),
        ("torch.storage", "_load_from_bytes"),
    ],
)
@pytest.mark.parametrize("protocol", [0, 4])
def test_every_other_name_is_refused(tmp_path: Path, module: str, name: str, protocol: int) -> None:
    if protocol == 0:
        raw = f"c{module}\n{name}\n.".encode()
    else:
        texts = b"".join(b"\x8c" + bytes([len(text)]) + text.encode() for text in (module, name))
        raw = b"\x80\x04" + texts + b"\x93."
    pickletools.dis(raw, out=io.StringIO())  # it is a pickle
    (tmp_path / "x.pkl").write_bytes(raw)

    with pytest.raises(DataError) as caught:
        pickles.load(tmp_path / "x.pkl")

    assert f"{module}.{name}" in str(caught.value)


@given(st.binary(max_size=60))
def test_any_bytes_are_a_value_or_a_data_error(tmp_path_factory: pytest.TempPathFactory, raw: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzz.pkl"
    path.write_bytes(raw)
    with contextlib.suppress(DataError):
        pickles.load(path)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no such file.*x\.pkl"):
        pickles.load(tmp_path / "x.pkl")
