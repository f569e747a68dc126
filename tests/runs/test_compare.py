"""Runs side by side: paired on shared samples, with what changed and which samples flipped."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import pictures
from a4agent.benchmarks import registry
from a4agent.errors import DataError
from a4agent.imaging.masks import decode_rle, encode_rle
from a4agent.runs import scores
from a4agent.runs.bench import Bench, Selection
from a4agent.runs.compare import compare, losses, to_dict
from a4agent.runs.store import Record

MakeBench = Callable[..., Bench]


def test_the_difference_is_that_of_the_shared_samples(bench: MakeBench) -> None:
    first = bench("a", selection=Selection(15)).run(pictures.agent(shift=6))
    second = bench("b").run(pictures.agent())
    pair = compare(first, second)
    shared = [id for id in first.records if id in second.records]
    assert (pair.result.n_shared, pair.result.n_only_first, pair.result.n_only_second) == (15, 0, 5)
    expected = sum(second.records[id].iou - first.records[id].iou for id in shared) / len(shared)
    assert pair.result.differences["giou"].value == pytest.approx(expected)
    assert pair.result.differences["giou"].clear
    flipped = {id for id in shared if first.records[id].iou <= 0.5 < second.records[id].iou}
    assert set(pair.result.gained) == flipped
    assert flipped
    assert not pair.result.lost


def test_what_changed_is_named(bench: MakeBench) -> None:
    first, second = bench("a").run(pictures.agent(shift=6)), bench("b").run(pictures.agent())
    assert "experts[2].id: 'scripted:detector-6' there, 'scripted:detector-0' here" in compare(first, second).changed


def test_a_run_against_itself_differs_in_nothing(bench: MakeBench) -> None:
    run = bench().run(pictures.agent())
    pair = compare(run, run)
    assert pair.changed == ()
    assert all(found.value == 0 and not found.clear for found in pair.result.differences.values())


def test_runs_on_other_data_are_not_compared(bench: MakeBench, tmp_path: Path) -> None:
    other = registry.load("folder", pictures.write_folder(tmp_path / "other", 5, first=100))
    with pytest.raises(DataError, match=r"a' and '.*b': .*share no sample"):
        compare(bench("a").run(pictures.agent()), bench("b", benchmark=other).run(pictures.agent()))


def test_losses_need_runs_that_differ_in_the_oracle_alone(bench: MakeBench) -> None:
    plain = bench("a").run(pictures.agent())
    other_system = bench("b", oracle="detector").run(pictures.agent(shift=6))
    assert losses([plain, other_system]) == []
    same_system = bench("c", oracle="detector").run(pictures.agent())
    (table,) = losses([plain, other_system, same_system])
    assert table[1].giou == pytest.approx(scores.score(same_system).giou)


def test_the_json_holds_it_all(bench: MakeBench) -> None:
    runs = [bench("a").run(pictures.agent()), bench("b", oracle="detector").run(pictures.agent())]
    found = json.loads(json.dumps(to_dict([compare(*runs)], losses(runs)), allow_nan=False))
    assert found["pairs"][0]["changed"] == ["oracle: nothing there, 'detector' here"]
    assert found["losses"][0][1]["cost"]["value"] == pytest.approx(found["pairs"][0]["differences"]["giou"]["value"])


def test_a_truth_of_equal_area_elsewhere_is_another_truth(bench: MakeBench) -> None:
    run = bench().run(pictures.agent())
    moved = dict(run.records)
    truth = decode_rle(moved["picture 4"].truth)
    moved["picture 4"] = Record({**moved["picture 4"].row, "truth": encode_rle(truth[::-1])})
    with pytest.raises(DataError, match="the true mask of 'picture 4' is not the same in both"):
        compare(run, replace(run, records=moved))


def test_contact_hits_are_paired(bench: MakeBench) -> None:
    first, second = bench("a").run(pictures.agent(shift=20)), bench("b").run(pictures.agent())
    (line,) = (line for line in compare(first, second).lines() if line.name == "contact")
    assert (line.label, line.percent) == ("contact hits", True)
    hits = [r.measures["contact"] for r in second.records.values() if r.measures["contact"] is not None]
    assert line.second == pytest.approx(sum(hits) / len(hits))
    assert line.change.value == pytest.approx(line.second - line.first)
    assert line.change.clear
