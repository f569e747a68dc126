"""The reference names every module: public ones by a directive, the rest in its last section."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
PUBLIC_PART, PRIVATE_PART = (ROOT / "docs" / "reference.md").read_text(encoding="utf-8").split("## Private")
PUBLIC = set(re.findall(r"^::: (a4agent[\w.]*)$", PUBLIC_PART, re.M))
PRIVATE = set(re.findall(r"`(a4agent[\w.]*)`", PRIVATE_PART))
SOURCE = ROOT / "src"
MODULES = {
    ".".join(path.relative_to(SOURCE).with_suffix("").parts)
    for path in SOURCE.glob("a4agent/**/*.py")
    if path.name != "__init__.py"
}
PACKAGES = {".".join(path.parent.relative_to(SOURCE).parts) for path in SOURCE.glob("a4agent/**/__init__.py")}


def test_every_module_is_public_or_named_private() -> None:
    covered = {module for module in MODULES if any(module.startswith(f"{name}.") for name in PRIVATE & PACKAGES)}
    assert MODULES - PUBLIC - PRIVATE - covered == set()


def test_the_reference_names_only_what_exists() -> None:
    assert set() == PUBLIC - MODULES
    assert set() == PRIVATE - MODULES - PACKAGES
    assert set() == PUBLIC & PRIVATE


def test_top_level_names_come_from_public_modules() -> None:
    import a4agent

    things = [getattr(a4agent, name) for name in a4agent.__all__ if not name.startswith("__")]
    homes = {getattr(thing, "__module__", None) or thing.__name__ for thing in things}
    assert homes <= PUBLIC
