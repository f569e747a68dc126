"""What the fuzzer found before stays fixed, and it still finds what it should."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parent.parent
REGRESSIONS = Path(__file__).parent / "regressions"
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="alarms of POSIX")


@pytest.fixture(scope="module")
def fuzz() -> ModuleType:
    spec = importlib.util.spec_from_file_location("fuzz", ROOT / "perf" / "fuzz.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["fuzz"] = module
    spec.loader.exec_module(module)
    return module


def test_inputs_found_before_are_refused_properly(fuzz: ModuleType) -> None:
    assert len(list(REGRESSIONS.iterdir())) >= 4
    assert fuzz.replay(REGRESSIONS) == []


def test_a_reader_that_fails_or_hangs_is_found(
    fuzz: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def hang(data: bytes, folder: Path) -> None:
        while True:
            pass

    def fail(data: bytes, folder: Path) -> None:
        raise RuntimeError("broken")

    monkeypatch.setattr(fuzz, "SECONDS", 1)
    fuzz.watch()
    monkeypatch.setitem(fuzz.READERS, "rle", (hang, list))
    assert fuzz.try_one("rle", b"", tmp_path) == "takes more than 1 s"
    monkeypatch.setitem(fuzz.READERS, "rle", (fail, list))
    assert fuzz.try_one("rle", b"", tmp_path).startswith("RuntimeError at test_fuzz.py")
