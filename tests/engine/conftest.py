"""Queries and agents that the engine's tests share."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from a4agent.config import EngineSettings
from a4agent.types import Query


def picture(number: int) -> np.ndarray:
    """A small picture like no other."""
    array = np.zeros((12, 16, 3), np.uint8)
    array[..., 0], array[..., 1], array[..., 2] = number % 256, number // 256 % 256, number // 65536
    return array


@pytest.fixture
def queries() -> Callable[[int], Iterator[Query]]:
    """The first so many queries: all pictures and instructions differ."""
    return lambda count: (Query(f"q{number}", picture(number), f"use thing {number}") for number in range(count))


@pytest.fixture
def write(tmp_path: Path) -> EngineSettings:
    """Settings with a cache of their own."""
    return EngineSettings(cache="write", cache_dir=tmp_path / "cache")


@pytest.fixture(autouse=True)
def _no_thread_left() -> Iterator[None]:
    """Every engine ends its threads; those of calls that never return are the tests' own business."""
    before = set(threading.enumerate())
    yield
    for thread in threading.enumerate():
        if thread not in before and thread.name.startswith("a4 "):
            thread.join(2.0)
            assert not thread.is_alive(), f"{thread.name} is still there"
