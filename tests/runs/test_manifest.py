"""What decides the answers of a run, and what does not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from a4agent.config import Settings
from a4agent.errors import DataError
from a4agent.runs.manifest import Manifest, differences, git_state, prompt_hashes, settings_identity, settings_shown


def made(**changes: Any) -> Settings:
    table: dict[str, Any] = {
        "name": "mine",
        "thinker": {"vlm": {"expert": "openai:gpt-4o", "base_url": "http://127.0.0.1:1", "api_key": "sk-1"}},
        "spotter": {"detector": "rex-omni:x", "segmenter": {"expert": "sam2:large", "max_batch": 4}},
    }
    for name, value in changes.items():
        *path, last = name.split("__")
        below = table
        for key in path:
            below = below.setdefault(key, {})
        below[last] = value
    return Settings.model_validate(table)


def test_what_no_answer_depends_on_is_not_part_of_a_configuration() -> None:
    plain = settings_identity(made())
    assert plain["spotter"]["segmenter"] == "sam2:large"
    same = [
        made(spotter__segmenter__max_batch=1),
        made(thinker__vlm__base_url="http://127.0.0.1:2"),
        made(engine={"cache": "write", "max_cost": 3.0}),
        made(name="yours", profile={"summary": "other words"}),
    ]
    assert all(settings_identity(settings) == plain for settings in same)
    other = [
        made(spotter__segmenter__expert="sam2:tiny"),
        made(spotter__pairing="paper"),
        made(thinker__reasks=0),
        made(dreamer={"vlm": "a:b", "editor": "c:d"}),
        made(image={"max_pixels": 1000}),
    ]
    assert not any(settings_identity(settings) == plain for settings in other)


def test_a_key_is_told_to_nobody() -> None:
    told = settings_shown(made(thinker__max_tokens=99))
    assert "sk-1" not in str(told)
    assert told["thinker"]["vlm"]["api_key"] == "***"
    assert told["thinker"]["max_tokens"] == 99


def test_the_prompts_are_those_that_are_used() -> None:
    without, with_one = prompt_hashes(made()), prompt_hashes(made(dreamer={"vlm": "a:b", "editor": "c:d"}))
    assert set(without) == {"thinker_one_image"}
    assert set(with_one) == {"dreamer", "thinker"}
    assert prompt_hashes(made(thinker=None)) == {}


def test_the_hash_names_the_configuration_and_not_its_circumstances() -> None:
    selection = {"limit": None, "shuffle": None, "samples": 3}
    identity = {"benchmark": "umd", "protocol": "strict", "oracle": None, "selection": selection}
    one = Manifest({**identity, "settings": {"x": 1, "y": 2}}, {"profile": "paper"})
    assert one.hash == Manifest({"settings": {"y": 2, "x": 1}, **identity}).with_session().hash
    assert one.hash != Manifest({**identity, "settings": {"x": 1, "y": 3}}).hash
    again = Manifest.from_json(one.with_session().to_json(), "manifest.json")
    assert again.hash == one.hash
    assert "numpy" in again.sessions[0]["versions"]


def test_a_system_is_the_same_on_every_benchmark() -> None:
    settings = {"spotter": {"pairing": "paper"}}
    umd, ours = (Manifest({"benchmark": name, "settings": settings, "oracle": None}) for name in ("umd", "folder"))
    assert umd.system == ours.system
    assert umd.hash != ours.hash
    assert umd.system != Manifest({"benchmark": "umd", "settings": settings, "oracle": "thinker"}).system


def test_a_label_says_what_stands_in_by_the_truth() -> None:
    assert Manifest({"oracle": None}, {"profile": "paper", "label": ""}).label == "paper"
    assert Manifest({"oracle": "detector"}, {"profile": "paper", "label": "A"}).label == "A, detector by the truth"


def test_all_labels_of_a_configuration_are_kept() -> None:
    manifest = Manifest({}, {"profile": "mine", "label": "first"})
    assert (Manifest({}).labels, manifest.labels) == ((), ("first",))
    for label in ("second", "first", ""):
        manifest = Manifest({}, {"profile": "mine", "label": label}).merged_with(manifest)
    assert (manifest.label, manifest.labels) == ("first", ("first", "second"))


def test_differences_are_named_by_their_place() -> None:
    assert differences({"a": {"b": 1}, "c": [1, 2]}, {"a": {"b": 2}, "c": [1, 2]}) == ["a.b: 1 there, 2 here"]
    assert differences({"a": [{"id": "x"}]}, {"a": [{"id": "y"}]}) == ["a[0].id: 'x' there, 'y' here"]
    assert differences({"a": 1}, {"a": 1, "b": 2}) == ["b: nothing there, 2 here"]
    assert differences({"a": [1]}, {"a": [1, 2]}) == ["a: [1] there, [1, 2] here"]


def test_only_a_checkout_of_this_code_is_told(tmp_path: Path) -> None:
    assert git_state(tmp_path) is None


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (b"", "Expecting value"),
        (b"[]", "should be a valid dictionary"),
        (b"\x89PNG\r\n", "can't decode byte"),
        (b"[" * 100_000, "recursion"),
        (b'{"schema": 99, "identity": {}, "about": {}, "sessions": []}', "schema 99; this version reads 1"),
        (b'{"schema": 1, "identity": {}, "about": {}, "sessions": []}', "identity.benchmark: Field required"),
    ],
)
def test_a_damaged_manifest_is_one_line(text: bytes, reason: str) -> None:
    with pytest.raises(DataError, match=reason) as raised:
        Manifest.from_json(text, "run/manifest.json")
    assert "run/manifest.json" in str(raised.value)
    assert "\n" not in str(raised.value)
