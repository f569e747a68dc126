"""The published tables, and our rows beside them."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import pictures
from a4agent.benchmarks import registry
from a4agent.errors import DataError
from a4agent.runs import published, scores
from a4agent.runs.bench import Bench, Selection
from a4agent.runs.store import Run
from a4agent.runs.tables import FORMS, Cell, Filled, TableLine, fill, group_of

MakeBench = Callable[..., Bench]


@pytest.fixture
def on(bench: MakeBench, data: Path) -> Callable[..., Run]:
    """A run that claims to be on a benchmark of the paper."""

    def make(name: str, shift: int = 0, **more: object) -> Run:
        benchmark = replace(registry.load("folder", data), name=name)
        return bench(f"{name} {shift}", benchmark=benchmark, **more).run(pictures.agent(shift=shift))

    return make


def test_our_row_stands_under_the_published_one_of_its_name(on: Callable[..., Run]) -> None:
    (table,) = fill([on("umd", label="Seg-Zero")])
    names = [(line.name, line.source == "ours") for line in table.lines]
    assert names.index(("Seg-Zero", True)) == names.index(("Seg-Zero", False)) + 1
    assert {name for name, ours in names if not ours} == set(published.table("umd").rows)


def test_groups_are_never_in_one_ranking(on: Callable[..., Run]) -> None:
    (table,) = fill([on("umd", label="mine"), on("umd", 1, label="peeking", oracle="detector")])
    groups = [line.group for line in table.lines]
    assert groups == sorted(groups, key=list(published.GROUPS).index)
    group = {line.name: line.group for line in table.lines}
    assert (group["A4-Agent"], group["mine"], group["Affordance-R1"]) == ("training-free", "training-free", "trained")
    assert group["peeking, detector by the truth"] == "truth"
    text = table.render("markdown")
    headings = [text.index(f"| *{published.GROUPS[name]}*") for name in ("training-free", "trained", "truth")]
    assert headings == sorted(headings)
    assert "truth of the test set seen: yes" in text
    assert "Not in this table, trained for this kind of task: AFUN (arXiv 2606.02551" in text
    assert r"\multicolumn{5}{l}{\emph{trained for this kind of task}}" in table.render("latex")


def test_what_is_declared_decides_the_group(run: Run) -> None:
    def group(**leaks: str) -> str:
        manifest = replace(run.manifest, about={**run.manifest.about, "leaks": leaks})
        return group_of([replace(run, manifest=manifest)])

    assert group() == "training-free"
    assert group(trained="yes") == "trained"
    assert group(trained="yes", shared="yes") == "truth"
    external = replace(run.manifest, identity={**run.manifest.identity, "predictions": "sha"})
    assert group_of([replace(run, manifest=external)]) == "undeclared"


def test_a_configuration_is_found_under_each_name_that_a_table_gave_it(on: Callable[..., Run]) -> None:
    for label in ("without Dreamer, GPT-4o", "Thinker + Spotter", "GPT-4o, SAM2-L"):
        on("ragnet-3doi", label=label)
    run = on("ragnet-3doi")
    assert run.manifest.label == "GPT-4o, SAM2-L", "a start without a name takes none away"
    for key, name in {
        "ablation-imagination": "without Dreamer, GPT-4o",
        "ablation-components": "GPT-4o, SAM2-L",
        "ablation-stages": "Thinker + Spotter",
        "ragnet": "GPT-4o, SAM2-L",
    }.items():
        (table,) = fill([run], key)
        assert [line.name for line in table.lines if line.source == "ours"] == [name]
        assert any(note.startswith(f"{name} on ragnet-3doi") for note in table.notes)


def test_a_cell_is_the_runs_score_in_percent(on: Callable[..., Run]) -> None:
    run = on("umd")
    (table,) = fill([run])
    found = scores.score(run)
    ours = next(line for line in table.lines if line.source == "ours")
    assert [cell.value for cell in ours.cells] == [
        100 * value for value in (found.giou, found.ciou, found.p50, found.p50_95)
    ]
    low, high = found.intervals["giou"]
    assert ours.cells[0].half_width == pytest.approx(50 * (high - low))
    assert any("protocol strict, 20 samples, 20 scored, 4 failed" in note for note in table.notes)


def test_one_system_on_several_benchmarks_is_one_row(on: Callable[..., Run]) -> None:
    runs = [on("ragnet-3doi"), on("ragnet-handal-hard"), on("ragnet-3doi", shift=5)]
    (table,) = fill(runs)
    ours = [line for line in table.lines if line.source == "ours"]
    assert len(ours) == 2
    assert [cell.value is None for cell in ours[0].cells] == [False, False, True, True, False, False]
    assert [cell.value is None for cell in ours[1].cells] == [False, False, True, True, True, True]


def test_a_benchmark_without_a_published_table_gets_one_of_its_own(on: Callable[..., Run]) -> None:
    tables = fill([on("reasonaff"), on("folder", selection=Selection(3))])
    assert [table.title.partition(":")[0] for table in tables] == ["Table 1 of arXiv 2512.14442", "folder"]
    assert "the first 3" in tables[1].notes[0]


def test_a_table_that_no_run_belongs_to_is_an_error(on: Callable[..., Run]) -> None:
    with pytest.raises(DataError, match="ragnet-3doi"):
        fill([on("umd")], "ablation-stages")


TABLE = Filled(
    "A & B",
    ("gIoU", "cIoU"),
    2,
    (TableLine("50% of_it|", (Cell(12.345), Cell(None))), TableLine("ours", (Cell(50.0, 2.34), Cell(1.0)), "ours")),
    ("10% left out",),
)


def test_markdown_lines_up_and_escapes() -> None:
    lines = TABLE.render("markdown").splitlines()
    assert lines[2:6] == [
        "| Model           |        gIoU | cIoU |",
        "|-----------------|------------:|-----:|",
        "| 50% of_it\\|     |       12.35 |    – |".replace("12.35", "12.35"),
        "| **ours** (ours) | 50.00 ± 2.3 | 1.00 |",
    ]


def test_latex_escapes_what_latex_reads() -> None:
    text = TABLE.render("latex")
    assert r"50\% of\_it| & 12.35 & -- \\" in text or r"50\% of\_it| & 12.34 & -- \\" in text
    assert r"\textbf{ours} (ours) & 50.00 $\pm$ 2.3 & 1.00 \\" in text
    assert r"\caption{A \& B}" in text
    assert text.count(r"\begin") == text.count(r"\end") == 2
    assert text.startswith("% 10% left out\n")


def test_csv_reads_back() -> None:
    rows = list(csv.DictReader(io.StringIO(TABLE.render("csv"))))
    assert rows[1]["gIoU"] == "50.00"
    assert rows[1]["gIoU 95% half width"] == "2.34"
    assert rows[0]["cIoU"] == ""
    assert [row["source"] for row in rows] == ["published", "ours"]


@pytest.mark.parametrize("form", FORMS)
def test_every_form_ends_with_a_newline(form: str) -> None:
    assert TABLE.render(form).endswith("\n")  # type: ignore[arg-type]
