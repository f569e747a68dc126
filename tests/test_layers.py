"""The house stands: layers, the public surface, and an import that costs nothing."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import a4agent

ROOT = Path(__file__).parent.parent
SRC = ROOT / "src" / "a4agent"


def test_no_import_points_up() -> None:
    result = subprocess.run(
        [str(Path(sys.executable).parent / "lint-imports"), "--no-cache"], cwd=ROOT, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stdout + result.stderr


def test_the_public_surface() -> None:
    assert sorted(a4agent.__all__) == [
        "A4Agent",
        "Affordance",
        "Check",
        "Given",
        "Imagination",
        "Query",
        "Region",
        "Target",
        "Trace",
        "errors",
        "load_image",
    ]
    for name in a4agent.__all__:
        assert getattr(a4agent, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'Agent'"):
        _ = a4agent.Agent


def test_importing_brings_no_library() -> None:
    code = (
        "import sys, a4agent; print(sorted({'numpy', 'PIL', 'pydantic', 'torch', 'scipy', 'rich'} & set(sys.modules)))"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"


def test_help_imports_no_command() -> None:
    code = (
        "import sys\n"
        "from a4agent.cli.main import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "print(sorted(n for n in sys.modules if n in ('numpy', 'pydantic', 'torch') or n.startswith('a4agent.cli.')))"
    )
    last = subprocess.check_output([sys.executable, "-c", code], text=True).splitlines()[-1]
    assert last == "['a4agent.cli.common', 'a4agent.cli.main']"


def test_no_file_grows_far_over_400_lines() -> None:
    long = {str(p.relative_to(SRC)): n for p in SRC.rglob("*.py") if (n := len(p.read_text().splitlines())) > 450}
    assert set(long) <= {"client.py"}  # one file that a robot can copy
    assert max(long.values(), default=0) < 500


def test_every_module_says_what_it_is() -> None:
    undocumented = [
        str(path.relative_to(ROOT))
        for path in SRC.rglob("*.py")
        if not path.read_text(encoding="utf-8").lstrip().startswith(('"""', 'r"""'))
    ]
    assert not undocumented


def test_no_class_name_is_used_twice() -> None:
    """But by the client, one file that has the names of the library's own types."""
    names = [
        node.name
        for path in SRC.rglob("*.py")
        if path.name != "client.py"
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef)
    ]
    assert sorted({name for name in names if names.count(name) > 1}) == []
