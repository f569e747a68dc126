"""The published numbers as data (published.toml), and suites: all systems of one table, as a small TOML file.

    table = published.table("umd")
    table.rows["Affordance-R1"]                # (49.85, 42.24, 53.35, 34.08), percent
    table.columns[0]                           # Column(name="gIoU", benchmark="umd", measure="giou")

The suites of the paper's tables come with the package:

    table = "ablation-stages"                       # a key of published.toml; it names the benchmarks

    [[system]]
    label = "Spotter"                               # the row of the table
    profile = "spotter-only"
    set = { "spotter.segmenter" = "sam2:tiny" }     # settings replaced, if any

Without `table`, `benchmarks = ["folder", ...]` names what to run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from a4agent.errors import ConfigError, UnknownNameError, first_problem
from a4agent.files import read_package_toml, read_toml

SOURCE = "arXiv 2512.14442"
OURS = "A4-Agent"
SUITES = Path(__file__).parent / "suites"
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
        UnknownNameError: no such table; the message suggests the nearest.
    """
    if key not in tables():
        raise UnknownNameError.of("table", key, tables())
    return tables()[key]


def of_benchmark(benchmark: str) -> Table | None:
    """The table that compares systems on this benchmark, None if the paper has none."""
    return next((table for table in tables().values() if benchmark in table.benchmarks), None)


class System(BaseModel):
    """One row: a profile, and the settings to replace."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    label: str
    profile: str
    set: dict[str, Any] = {}


class Suite(BaseModel):
    """The systems of one table and the benchmarks they run on."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    table: str | None = None
    benchmarks: tuple[str, ...] = ()
    system: tuple[System, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _has_benchmarks(self) -> Suite:
        if not self.table and not self.benchmarks:
            raise ValueError("a suite needs 'table' or 'benchmarks'")
        return self

    def benchmark_names(self) -> tuple[str, ...]:
        """The benchmarks that every system runs on."""
        return self.benchmarks or table(str(self.table)).benchmarks


def suite_names() -> list[str]:
    """The suites that come with the package."""
    return sorted(path.stem for path in SUITES.glob("*.toml"))


def load_suite(name: str) -> Suite:
    """A suite by name or TOML file.

    Raises:
        UnknownNameError: neither; the message suggests the nearest.
        ConfigError: the file is not a suite.
    """
    path = Path(name) if name.endswith(".toml") else SUITES / f"{name}.toml"
    if not path.is_file():
        raise UnknownNameError.of("suite", name, suite_names())
    try:
        return Suite.model_validate(read_toml(path))
    except ValidationError as error:
        raise ConfigError(f"suite {name!r}: {first_problem(error, 'the file')}") from error
