"""The paper's tables as suites: every system can be set up, and every row is one of the table."""

from __future__ import annotations

from pathlib import Path

import pytest

from a4agent.benchmarks import registry
from a4agent.config import load_settings
from a4agent.errors import ConfigError, UnknownNameError
from a4agent.runs import published
from a4agent.runs.manifest import settings_identity
from a4agent.runs.suites import load_suite, suite_names


def test_there_is_a_suite_for_every_table_of_the_paper() -> None:
    assert suite_names() == [f"paper-table-{table.number}" for table in published.tables().values()]


@pytest.mark.parametrize("name", suite_names())
def test_a_suite_has_loadable_systems_named_as_the_table_names_them(name: str) -> None:
    suite = load_suite(name)
    table = published.table(str(suite.table))
    assert name == f"paper-table-{table.number}"
    assert set(suite.benchmark_names()) <= set(registry.names())
    labels = [system.label for system in suite.system]
    assert set(labels) <= set(table.rows)
    found = [
        settings_identity(load_settings(s.profile, s.set, environ={}, folder=Path("nowhere"))) for s in suite.system
    ]
    assert all(a != b for i, a in enumerate(found) for b in found[:i]), "no two rows are the same system"


def test_the_ablations_are_complete() -> None:
    """All rows of ours in tables 4 to 6 can be run; the rest are baselines with code of their own."""
    for number in (4, 5, 6):
        suite = load_suite(f"paper-table-{number}")
        left = set(published.table(str(suite.table)).rows) - {system.label for system in suite.system}
        assert left <= {"AffordanceVLM"}


def test_a_suite_of_your_own_is_a_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('benchmarks = ["folder"]\n[[system]]\nlabel = "a"\nprofile = "offline"\n')
    assert load_suite(str(path)).benchmark_names() == ("folder",)
    path.write_text('[[system]]\nlabel = "a"\nprofile = "offline"\n')
    with pytest.raises(ConfigError, match="needs 'table' or 'benchmarks'"):
        load_suite(str(path))
    path.write_text('table = "umd"\n[[system]]\nlabel = "a"\nprofil = "offline"\n')
    with pytest.raises(ConfigError, match=r"system\.0\.profile"):
        load_suite(str(path))


def test_an_unknown_suite_suggests_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'paper-table-4'"):
        load_suite("paper-table4")
