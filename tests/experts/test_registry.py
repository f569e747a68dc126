"""From "provider:model" to an expert, and what is said when there is none."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from typing import Any

import numpy as np
import pytest

from a4agent.errors import ConfigError, UnknownNameError
from a4agent.experts import registry
from a4agent.testing import ScriptedDetector


def make(model: str, role: str, *, size: int = 3, name: str | None = None, rate: float = 1.0, more: Any = None) -> Any:
    return ScriptedDetector(id=f"mine:{model}", max_batch=size)


@pytest.fixture(autouse=True)
def _mine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry.plugins, "added", {"mine": make})


def test_an_expert_gets_its_model_and_settings() -> None:
    expert = registry.create("mine:a/b:c", "detector", {"size": 5})
    assert (expert.id, expert.max_batch) == ("mine:a/b:c", 5)


@pytest.mark.parametrize("spec", ["mine", ":model", ""])
def test_a_spec_without_provider_and_colon_is_explained(spec: str) -> None:
    with pytest.raises(ConfigError, match="provider:model"):
        registry.create(spec, "detector")


def test_an_unknown_provider_suggests_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'sam2'"):
        registry.create("sam22:tiny", "segmenter")


def test_an_unknown_setting_suggests_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="'sizes'; did you mean 'size'"):
        registry.create("mine:x", "detector", {"sizes": 5})


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"size": "five"}, "'size' of 'mine:x' takes a whole number, not 'five'"),
        ({"size": True}, "a whole number, not True"),
        ({"name": 1234567}, "a text .*quotes.*, not 1234567"),
        ({"rate": "fast"}, "a number, not 'fast'"),
    ],
)
def test_a_value_of_the_wrong_kind_is_explained(settings: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        registry.create("mine:x", "detector", settings)


@pytest.mark.parametrize(
    "settings", [{"rate": 2}, {"rate": np.float32(2)}, {"size": np.int64(2)}, {"name": None}, {"more": [1]}]
)
def test_what_counts_as_the_right_kind_is_taken(settings: dict[str, object]) -> None:
    assert registry.create("mine:x", "detector", settings)


class Provider(ScriptedDetector):
    size: str = "a setting is named like this, and is no text"

    def __init__(self, model: str, role: str, *, size: int = 3) -> None:
        super().__init__(max_batch=size)


def test_a_class_is_a_factory_by_its_constructor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(registry.plugins.added, "class", Provider)
    assert registry.create("class:x", "detector", {"size": 5}).max_batch == 5
    with pytest.raises(ConfigError, match="a whole number, not 'five'"):
        registry.create("class:x", "detector", {"size": "five"})


def unreadable(model: str, role: NoSuchRole, *, size: int = 3) -> Any:  # type: ignore[name-defined]  # noqa: F821
    return ScriptedDetector(max_batch=int(size))


def test_a_factory_whose_annotations_only_a_type_checker_can_read_checks_for_itself(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(registry.plugins.added, "unreadable", unreadable)
    assert registry.create("unreadable:x", "detector", {"size": "5"}).max_batch == 5


def test_a_role_the_expert_cannot_play_is_refused() -> None:
    with pytest.raises(ConfigError, match="cannot be the vlm"):
        registry.create("mine:x", "vlm")


def test_a_class_that_cannot_play_a_role_is_refused_before_it_is_built(monkeypatch: pytest.MonkeyPatch) -> None:
    class Chats:
        def __init__(self, model: str, role: str) -> None:
            raise AssertionError("built")

        def chat(self, requests: object) -> list[object]:
            return []

    monkeypatch.setitem(registry.plugins.added, "chats", Chats)
    with pytest.raises(ConfigError, match=r"'chats:x' cannot be the detector: .* makes a VLM a detector"):
        registry.create("chats:x", "detector")


def test_all_built_in_providers_are_entry_points() -> None:
    assert {"openai", "transformers", "rex-omni", "sam2", "offline", "vlm-grounding"} <= set(registry.providers())


def test_a_broken_plugin_is_a_warning_that_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = EntryPoint("broken", "no_such_module_anywhere:create", registry.plugins.group)
    monkeypatch.setattr(registry.plugins, "_installed", {"broken": broken})
    with pytest.warns(UserWarning, match="broken.*no_such_module_anywhere"), pytest.raises(ConfigError, match="broken"):
        registry.create("broken:x", "vlm")
