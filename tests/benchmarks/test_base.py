"""The contract that every reader keeps: unique ids, lazy masks, and no answer in what an agent is handed."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from a4agent.benchmarks.registry import load
from a4agent.types import Query
from layouts import SECRET

LAYOUTS = [
    ("folder", "folder_path", {}, 3),
    ("folder", "coco_path", {}, 2),
    ("ragnet-3doi", "ragnet_path", {}, 2),
    ("ragnet-handal-hard", "ragnet_path", {}, 2),
    ("umd", "umd_path", {"rule": "a4"}, 12),
    ("umd", "umd_path", {"rule": "affordance-r1"}, 12),
    ("instructpart", "instructpart_path", {"instruction": 1}, 4),
    ("reasonaff", "reasonaff_path", {}, 2),
]


@pytest.fixture(params=LAYOUTS, ids=lambda layout: f"{layout[0]}-{layout[1]}-{list(layout[2].values())}")
def layout(request: pytest.FixtureRequest) -> tuple:
    name, fixture, options, size = request.param
    path: Path = request.getfixturevalue(fixture)
    return load(name, path, options), path, name, options, size


def test_every_reader_keeps_the_contract(layout: tuple) -> None:
    benchmark, path, name, options, size = layout

    samples = list(benchmark)

    assert len(samples) == len(benchmark) == size
    assert len({sample.id for sample in samples}) == size
    for sample in samples:
        truth = sample.truth.mask()
        assert truth.dtype == np.bool_
        assert truth.ndim == 2
    again = load(name, path, options)
    assert [sample.id for sample in again] == [sample.id for sample in samples]
    assert again.fingerprint() == benchmark.fingerprint()
    assert benchmark.fingerprint()["rows"] == size
    assert benchmark[size - 1].id == samples[-1].id
    with pytest.raises(IndexError):
        benchmark[size]
    assert benchmark.licence
    assert benchmark.source


def test_no_answer_reaches_an_agent(layout: tuple) -> None:
    benchmark = layout[0]

    assert [field.name for field in dataclasses.fields(Query)] == ["id", "image", "instruction"]
    for sample in benchmark:
        assert type(sample.query) is Query
        assert not hasattr(sample.query, "__dict__") or set(vars(sample.query)) == {"id", "image", "instruction"}
        assert SECRET not in f"{sample.query.id} {sample.query.instruction} {sample.query.image!r}"


def test_masks_are_read_when_asked_for_not_before(folder_path: Path) -> None:
    benchmark = load("folder", folder_path)
    for file in folder_path.rglob("*_mask.png"):
        file.unlink()

    samples = list(benchmark)

    with pytest.raises(Exception, match="no such mask"):
        samples[0].truth.mask()


@pytest.mark.parametrize("change", ["mask", "image", "index"])
def test_a_fingerprint_changes_with_the_data(folder_path: Path, change: str) -> None:
    before = load("folder", folder_path).fingerprint()
    file = {"mask": "a/mug.v1_mask.png", "image": "b/mug.v2.jpg", "index": "samples.jsonl"}[change]

    (folder_path / file).write_bytes((folder_path / file).read_bytes() + b"\n")

    assert load("folder", folder_path).fingerprint() != before


def test_umd_under_another_rule_is_another_benchmark(umd_path: Path) -> None:
    first, second = (load("umd", umd_path, {"rule": rule}).fingerprint() for rule in ("a4", "affordance-r1"))

    assert first != second
    assert (first["options"], second["options"]) == ({"rule": "a4"}, {"rule": "affordance-r1"})
