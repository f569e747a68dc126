"""The published numbers and the suites: every system can be set up, and every row is one of the table."""

from __future__ import annotations

from pathlib import Path

import pytest

from a4agent.benchmarks import registry
from a4agent.config import load_settings
from a4agent.errors import ConfigError, UnknownNameError
from a4agent.metrics import MEASURES
from a4agent.runs import published
from a4agent.runs.manifest import settings_identity
from a4agent.runs.published import load_suite, suite_names


def test_every_published_table_is_rectangular_and_in_percent() -> None:
    tables = published.tables()
    assert [table.number for table in tables.values()] == [1, 2, 3, 4, 5, 6]
    for table in tables.values():
        assert all(len(values) == len(table.columns) for values in table.rows.values())
        assert all(0 <= value <= 100 for values in table.rows.values() for value in values)
        assert table.trained <= set(table.rows), "a misspelt name would be ranked among the training-free"
        assert all(column.measure in MEASURES for column in table.columns)
    assert published.table("umd").rows["A4-Agent"] == (65.38, 59.81, 77.31, 43.78)
    assert published.table("ragnet").rows["AffordanceVLM"] == (38.1, 39.4, 58.3, 58.1, 58.2, 57.8)
    assert published.table("ablation-components").rows["AffordanceVLM"] == (38.1, 39.4)
    assert published.table("ablation-stages").rows["Spotter"] == (45.91, 39.82)
    with pytest.raises(UnknownNameError, match="did you mean 'ragnet'"):
        published.table("ragnett")


def test_a_benchmark_has_the_table_that_compares_systems_on_it() -> None:
    found = published.of_benchmark("ragnet-3doi")
    assert found is not None
    assert found.key == "ragnet", "and not one of the ablations"
    assert published.of_benchmark("folder") is None


def test_newer_systems_have_a_source_and_a_group() -> None:
    assert published.peers()
    for peer in published.peers():
        assert peer.source.startswith("arXiv ")
        assert peer.group in published.GROUPS


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
