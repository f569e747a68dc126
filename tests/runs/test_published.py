"""The published numbers."""

from __future__ import annotations

import pytest

from a4agent.errors import UnknownNameError
from a4agent.metrics import MEASURES
from a4agent.runs import published


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
