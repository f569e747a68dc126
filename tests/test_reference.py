"""The reference names every module: public ones by a directive, the rest in its last section."""

from __future__ import annotations

import ast
import re
from importlib import import_module
from pathlib import Path
from types import FunctionType

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


def test_the_docs_use_public_modules_only() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    blocks = [block for page in pages for block in re.findall(r"```python\n(.*?)```", page.read_text("utf-8"), re.S)]
    blocks += [path.read_text("utf-8") for path in (ROOT / "examples").rglob("*.py")]
    used = {home for block in blocks for node in ast.walk(ast.parse(block)) for home in _homes(node)}
    assert used
    assert used <= PUBLIC


def _homes(node: ast.AST) -> set[str]:
    """The modules of this package that an import reaches: a name's own, where another module passes it on."""
    if isinstance(node, ast.Import):
        return {alias.name for alias in node.names if alias.name.startswith("a4agent.")}
    if not isinstance(node, ast.ImportFrom) or not f"{node.module}.".startswith("a4agent."):
        return set()
    homes: set[str] = set()
    for alias in node.names:
        full = f"{node.module}.{alias.name}"
        if full in MODULES | PACKAGES:
            homes.add(full)
        else:
            value = getattr(import_module(str(node.module)), alias.name)
            homes.add(value.__module__ if isinstance(value, type | FunctionType) else str(node.module))
    return homes
