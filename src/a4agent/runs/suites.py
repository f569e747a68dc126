"""A suite: all systems of one table, as a small TOML file. The paper's tables come with the package.

    table = "ablation-stages"                       # a key of published.toml; it names the benchmarks

    [[system]]
    label = "Spotter"                               # the row of the table
    profile = "spotter-only"
    set = { "spotter.segmenter" = "sam2:tiny" }     # settings replaced, if any

Without `table`, `benchmarks = ["folder", ...]` names what to run.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from a4agent.config import read_toml
from a4agent.errors import ConfigError, UnknownNameError, first_problem
from a4agent.runs import published

SUITES = Path(__file__).parent / "suites"


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
        return self.benchmarks or published.table(str(self.table)).benchmarks


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
