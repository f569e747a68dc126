"""A benchmark of drawn pictures and runs on it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import pictures
from a4agent.benchmarks import registry
from a4agent.config import Settings
from a4agent.runs.bench import Bench
from a4agent.runs.store import Run

SETTINGS = {
    "name": "scripted",
    "dreamer": {"vlm": "scripted:vlm", "editor": "scripted:editor"},
    "thinker": {"vlm": "scripted:vlm", "reasks": 0},
    "spotter": {"detector": "scripted:detector", "segmenter": "scripted:segmenter"},
}


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty drawn pictures."""
    return pictures.write_folder(tmp_path_factory.mktemp("data") / "drawn")


@pytest.fixture
def settings() -> Settings:
    return Settings.model_validate(SETTINGS)


@pytest.fixture
def bench(data: Path, tmp_path: Path, settings: Settings) -> Callable[..., Bench]:
    """Makes a `Bench` on the drawn pictures, in a folder of the test."""

    def make(out: str = "run", **more: Any) -> Bench:
        benchmark = more.pop("benchmark") if "benchmark" in more else registry.load("folder", data)
        return Bench(benchmark, more.pop("settings", settings), out=tmp_path / out, **more)

    return make


@pytest.fixture
def run(bench: Callable[..., Bench]) -> Run:
    """A complete run."""
    return bench().run(pictures.agent())
