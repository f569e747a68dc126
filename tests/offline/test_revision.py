"""The revision follows the rules and the knowledge."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from a4agent import offline
from a4agent.experts import registry


def test_all_three_experts_carry_it_in_their_fingerprint() -> None:
    for spec, role in (("offline:reasoner", "vlm"), ("offline:parts", "detector"), ("offline:parts", "segmenter")):
        assert registry.create(spec, role).fingerprint()["revision"] == offline.revision()  # type: ignore[arg-type]


def test_a_change_of_the_knowledge_changes_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = tmp_path / "offline"
    shutil.copytree(Path(offline.__file__).parent, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(offline, "__file__", str(copy / "__init__.py"))
    digest = offline.revision.__wrapped__
    before = digest()
    assert before == digest()
    with (copy / "knowledge.toml").open("a") as file:
        file.write("\n# one more thing\n")
    assert digest() != before
