"""Readers by name: the built-in ones and a stranger's, by the same door."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from a4agent.benchmarks import registry
from a4agent.benchmarks.base import Benchmark
from a4agent.errors import ConfigError, UnknownNameError


def test_a_misspelt_name_or_option_suggests_the_right_one(umd_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="'reasonaff'"):
        registry.load("reasonafff", umd_path)
    with pytest.raises(UnknownNameError, match="'rule'"):
        registry.load("umd", umd_path, {"rul": "a4"})
    with pytest.raises(UnknownNameError, match="'affordance-r1'"):
        registry.load("umd", umd_path, {"rule": "affordance_r1"})


def test_every_benchmark_of_the_package_opens_by_name() -> None:
    for name in registry.names():
        assert callable(registry.factory_of(name))


def test_a_strangers_reader(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def create(path: Path, *, split: str = "test") -> Benchmark:
        """Mine."""
        return Benchmark("mine", "MIT", "here", path, 0, lambda _: None, "0", {"split": split})  # pyright: ignore

    monkeypatch.setattr(registry.plugins, "added", {})
    registry.register("mine", create)

    assert "mine" in registry.names()
    assert registry.load("mine", tmp_path, {"split": "train"}).options == {"split": "train"}
    assert registry.options_of(create) == {"split": "test"}


def test_a_broken_plugin_is_a_warning_that_names_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    broken = EntryPoint("broken", "no_such_module_here:create", registry.plugins.group)
    monkeypatch.setattr(registry.plugins, "_installed", {"broken": broken})

    with pytest.warns(UserWarning, match="no_such_module_here"), pytest.raises(ConfigError, match="'broken'"):
        registry.load("broken", tmp_path)
    assert registry.names() == ["broken"]
