"""Whether the tests notice: small changes to the source, each run against the test file that mirrors it.

    python perf/mutants.py                       30 changes a room, drawn at random (half an hour of two quiet cores)
    python perf/mutants.py engine --sample 100   more of one room
    python perf/mutants.py --list metrics        every change that there is, without running one

A change that no test fails for has survived: either something is untested, or the change makes no difference. A run
that takes three times as long as the unchanged one counts as killed: the tests hang, and notice.
"""

from __future__ import annotations

import argparse
import ast
import copy
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
ROOMS = {
    "stages": ["stages/*.py"],
    "metrics": ["metrics.py"],
    "engine": ["engine/*.py"],
    "store": ["runs/store.py"],
    "readers": ["stages/target_json.py", "experts/grounding_answer.py", "experts/rex_omni_answer.py"],
}
ALSO = {
    "engine/session.py": ["engine/test_pipeline.py"],
    "engine/pipeline.py": ["engine/test_session.py", "engine/test_stopping.py"],
}
"""What else tests a file: a session is used through `run`, and `run` through sessions that stop."""
COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
NAMES = {
    "min": "max",
    "max": "min",
    "any": "all",
    "all": "any",
    "notify_all": "notify",
    "floor": "ceil",
    "ceil": "floor",
}


@dataclass(frozen=True)
class Mutant:
    """One change: the number of its node in the file's tree, which of that node's changes, and both in words."""

    path: Path
    line: int
    node: int
    change: int
    words: str

    @property
    def name(self) -> str:
        return f"{self.path.relative_to(ROOT / 'src' / 'a4agent')}:{self.line}"


def nodes(tree: ast.AST) -> Iterator[ast.AST]:
    """The nodes that may change, in a fixed order: neither annotations, nor docstrings, nor texts for people."""
    for child in ast.iter_child_nodes(tree):
        if isinstance(child, (ast.JoinedStr, ast.arguments, ast.Raise)):
            continue
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            continue
        if isinstance(child, ast.AnnAssign):
            yield from nodes(ast.Expression(child.value) if child.value else ast.Module([], []))
            continue
        yield child
        if isinstance(child, (ast.FunctionDef, ast.ClassDef)):
            yield from nodes(ast.Module(child.body, []))
        else:
            yield from nodes(child)


def changes(node: ast.AST) -> list[ast.AST]:
    """What a node may become."""
    found: list[ast.AST] = []
    if isinstance(node, ast.Compare) and type(node.ops[0]) in COMPARISONS:
        found.append(ast.Compare(node.left, [COMPARISONS[type(node.ops[0])](), *node.ops[1:]], node.comparators))
    elif isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
        found.append(ast.BinOp(node.left, OPERATORS[type(node.op)](), node.right))
    elif isinstance(node, ast.BoolOp):
        found.append(ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values))
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        found.append(node.operand)
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        found.append(ast.Constant(not node.value))
    elif isinstance(node, ast.Constant) and isinstance(node.value, (int, float)):
        found.append(ast.Constant(node.value + 1 if isinstance(node.value, int) else node.value * 2 + 0.1))
    elif isinstance(node, ast.Name) and node.id in NAMES:
        found.append(ast.Name(NAMES[node.id], node.ctx))
    elif isinstance(node, ast.Attribute) and node.attr in NAMES:
        found.append(ast.Attribute(node.value, NAMES[node.attr], node.ctx))
    elif isinstance(node, ast.Return) and node.value is not None and not isinstance(node.value, ast.Constant):
        found.append(ast.Return(ast.Constant(None)))
    elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        found.append(ast.Pass())
    elif isinstance(node, (ast.Break, ast.Continue)):
        found.append(ast.Continue() if isinstance(node, ast.Break) else ast.Break())
    elif isinstance(node, ast.If) and not isinstance(node.test, (ast.Compare, ast.UnaryOp, ast.BoolOp)):
        found.append(ast.If(ast.UnaryOp(ast.Not(), node.test), node.body, node.orelse))
    return found


def mutants(path: Path) -> Iterator[Mutant]:
    """All changes of a file."""
    for number, node in enumerate(nodes(ast.parse(path.read_text()))):
        for k, changed in enumerate(changes(node)):
            before, after = (ast.unparse(ast.fix_missing_locations(n)).splitlines()[0][:60] for n in (node, changed))
            yield Mutant(path, getattr(node, "lineno", 0), number, k, f"{before}  ->  {after}")


def source(mutant: Mutant) -> str:
    """The file with its change."""
    tree = ast.parse(mutant.path.read_text())
    target = list(nodes(tree))[mutant.node]
    changed = changes(copy.deepcopy(target))[mutant.change]

    class Change(ast.NodeTransformer):
        def visit(self, node: ast.AST) -> ast.AST:
            return ast.copy_location(changed, node) if node is target else self.generic_visit(node)

    return ast.unparse(ast.fix_missing_locations(Change().visit(tree)))


def tests_of(path: Path) -> list[Path]:
    """The test file that mirrors a file, and what else tests it."""
    relative = path.relative_to(ROOT / "src" / "a4agent")
    mirror = relative.parent / f"test_{relative.name}"
    return [ROOT / "tests" / name for name in (mirror, *ALSO.get(str(relative), []))]


def passes(tests: list[Path], package: Path, limit: float) -> bool | None:
    """Whether test files pass with the package in `package`; None if it took longer than `limit` seconds."""
    process = os.fork()
    if process == 0:
        os.setpgrp()
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.dup2(null, 2)
        os.environ["PYTHONPATH"] = str(package)
        sys.path.insert(0, str(package))
        import pytest

        os._exit(pytest.main(["-x", "-q", "-p", "no:cacheprovider", "--hypothesis-seed=0", *map(str, tests)]))
    deadline = time.monotonic() + limit
    while time.monotonic() < deadline:
        done, status = os.waitpid(process, os.WNOHANG)
        if done:
            return status == 0
        time.sleep(0.02)
    os.killpg(process, signal.SIGKILL)
    os.waitpid(process, 0)
    return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rooms", nargs="*", help=f"of {', '.join(ROOMS)}; all if none is named")
    parser.add_argument("--sample", type=int, default=30, help="changes a room")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--list", action="store_true", help="print all changes and run none")
    options = parser.parse_args()
    import numpy  # noqa: F401  imported here, each child has it for free
    import pydantic  # noqa: F401
    import pytest  # noqa: F401
    import scipy.optimize  # noqa: F401

    signal.signal(signal.SIGINT, signal.default_int_handler)
    table: dict[str, Counter[str]] = {}
    seconds: dict[Path, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        package = Path(folder) / "src"
        shutil.copytree(ROOT / "src" / "a4agent", package / "a4agent", ignore=shutil.ignore_patterns("__pycache__"))
        for room in options.rooms or ROOMS:
            paths = [path for pattern in ROOMS[room] for path in sorted((ROOT / "src" / "a4agent").glob(pattern))]
            found = [mutant for path in paths if tests_of(path)[0].exists() for mutant in mutants(path)]
            if options.list:
                print(*(f"{mutant.name}  {mutant.words}" for mutant in found), sep="\n")
                continue
            counts = table.setdefault(room, Counter())
            for mutant in random.Random(options.seed).sample(found, min(options.sample, len(found))):
                tests = tests_of(mutant.path)
                copied = package / mutant.path.relative_to(ROOT / "src")
                if mutant.path not in seconds:
                    started = time.monotonic()
                    assert passes(tests, package, 600.0), f"the tests of {mutant.path} fail without a change"
                    seconds[mutant.path] = time.monotonic() - started
                copied.write_text(source(mutant))
                verdict = passes(tests, package, 3 * seconds[mutant.path] + 5.0)
                copied.write_text(mutant.path.read_text())
                word = {True: "survived", False: "killed", None: "killed (hung)"}[verdict]
                counts[word.split()[0]] += 1
                print(f"{word:13} {mutant.name}  {mutant.words}", flush=True)
    print("\n| room | tried | killed | survived | killed |\n|---|---|---|---|---|")
    for room, counts in table.items():
        tried = counts.total()
        print(f"| {room} | {tried} | {counts['killed']} | {counts['survived']} | {counts['killed'] / tried:.0%} |")


if __name__ == "__main__":
    main()
