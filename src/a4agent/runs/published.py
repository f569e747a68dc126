"""The published numbers, as data (published.toml).

table = published.table("umd")
table.rows["Affordance-R1"]                # (49.85, 42.24, 53.35, 34.08), percent
table.columns[0]                           # Column(name="gIoU", benchmark="umd", measure="giou")
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from a4agent.errors import UnknownNameError
from a4agent.files import read_package_toml

SOURCE = "arXiv 2512.14442"
OURS = "A4-Agent"
GROUPS = {
    "training-free": "training-free",
    "trained": "trained for this kind of task",
    "truth": "with truth of the test set, as a memory or an oracle",
    "undeclared": "training not declared (a4 score --leak)",
}
"""The groups that systems are ranked in, and their headings."""


@dataclass(frozen=True)
class Column:
    """One column: `measure` is a field of `metrics.Scores`."""

    name: str
    benchmark: str
    measure: str


@dataclass(frozen=True)
class Peer:
    """A system without published numbers here: where it is described, its group of `GROUPS`, and a remark."""

    name: str
    source: str
    group: str
    note: str


@dataclass(frozen=True, eq=False)
class Table:
    """One table of the paper, in percent. `trained` names the rows that are not training-free."""

    key: str
    number: int
    title: str
    decimals: int
    columns: tuple[Column, ...]
    rows: Mapping[str, tuple[float, ...]]
    notes: tuple[str, ...]
    trained: frozenset[str] = frozenset()

    def group(self, name: str) -> str:
        """Which of `GROUPS` a row belongs to."""
        return "trained" if name in self.trained else "training-free"

    @property
    def benchmarks(self) -> tuple[str, ...]:
        """The benchmarks that its columns need, each once."""
        return tuple(dict.fromkeys(column.benchmark for column in self.columns))


@cache
def tables() -> dict[str, Table]:
    """All tables by key, in the paper's order."""
    return {
        key: Table(
            key=key,
            number=data["number"],
            title=data["title"],
            decimals=data["decimals"],
            columns=tuple(Column(**column) for column in data["columns"]),
            rows={name: tuple(values) for name, values in data["rows"].items()},
            notes=tuple(data["notes"]),
            trained=frozenset(data["trained"]),
        )
        for key, data in _file().items()
        if key != "peers"
    }


@cache
def peers() -> tuple[Peer, ...]:
    """Newer systems, listed without numbers."""
    return tuple(Peer(**peer) for peer in _file()["peers"])


@cache
def _file() -> dict[str, Any]:
    return read_package_toml("a4agent.runs", "published.toml")


def table(key: str) -> Table:
    """One table.

    Raises:
        UnknownNameError: there is none of that key; the message suggests the nearest.
    """
    if key not in tables():
        raise UnknownNameError.of("table", key, tables())
    return tables()[key]


def of_benchmark(benchmark: str) -> Table | None:
    """The table that compares systems on this benchmark, None if the paper has none."""
    return next((table for table in tables().values() if benchmark in table.benchmarks), None)
