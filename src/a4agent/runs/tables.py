"""The paper's tables with our rows next to the published ones, as Markdown, LaTeX or CSV.

    | Model                     | gIoU  | cIoU  |
    |---------------------------|------:|------:|
    | without Dreamer, GPT-4o   | 62.30 | 54.43 |
    | **without Dreamer, GPT-4o** (ours) | 61.87 ± 2.1 | 55.02 |

A row of ours is one system: runs of the same configuration on several benchmarks fill one row.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

from a4agent import metrics
from a4agent.errors import DataError
from a4agent.runs import published, scores
from a4agent.runs.manifest import LEAKS
from a4agent.runs.published import OURS, Table
from a4agent.runs.store import Run

Form = Literal["markdown", "latex", "csv"]
Source = Literal["published", "ours", "scored here"]
FORMS: tuple[Form, ...] = ("markdown", "latex", "csv")


@dataclass(frozen=True)
class Cell:
    """A value in percent, None without one; `half_width` is half of its 95 % interval."""

    value: float | None
    half_width: float | None = None


@dataclass(frozen=True)
class TableLine:
    """One row of a table. `source` is "published", "ours", or "scored here": another system's masks, our scores.

    `group` is one of `published.GROUPS`; rows of different groups are never in one ranking.
    """

    name: str
    cells: tuple[Cell, ...]
    source: Source = "published"
    group: str = "training-free"


@dataclass(frozen=True)
class Filled:
    """A table with published rows and ours. `notes` describe our runs."""

    title: str
    columns: tuple[str, ...]
    decimals: int
    lines: tuple[TableLine, ...]
    notes: tuple[str, ...]

    def render(self, form: Form) -> str:
        """The table as text, with a newline at its end."""
        return {"markdown": _markdown, "latex": _latex, "csv": _csv}[form](self)


def fill(runs: Sequence[Run], key: str | None = None) -> list[Filled]:
    """Every published table with a column for one of the runs, or the one named; then the benchmarks without a table.

    Raises:
        UnknownNameError: no such table.
        DataError: none of the runs is on a benchmark of the table.
    """
    if key:
        table = published.table(key)
        chosen = [run for run in runs if _benchmark(run) in table.benchmarks]
        if not chosen:
            on = ", ".join(sorted({_benchmark(run) for run in runs}))
            raise DataError(f"table {key!r} is of {', '.join(table.benchmarks)}, and the runs are on {on}")
        return [_filled(table, chosen)]
    tables = dict.fromkeys(published.of_benchmark(_benchmark(run)) for run in runs)
    found = [_filled(t, [r for r in runs if _benchmark(r) in t.benchmarks]) for t in tables if t]
    for benchmark in dict.fromkeys(_benchmark(run) for run in runs):
        if published.of_benchmark(benchmark) is None:
            found.append(_alone(benchmark, [run for run in runs if _benchmark(run) == benchmark]))
    return found


def _filled(table: Table, runs: Sequence[Run]) -> Filled:
    theirs = [
        TableLine(name, tuple(Cell(value) for value in values), group=table.group(name))
        for name, values in table.rows.items()
    ]
    ours = [
        TableLine(
            name,
            tuple(_cell(run_of.get(column.benchmark), column.measure) for column in table.columns),
            source,
            group_of(list(run_of.values()), table, name),
        )
        for name, source, run_of in _systems(runs, table.rows)
    ]
    return Filled(
        title=f"Table {table.number} of {published.SOURCE}: {table.title}",
        columns=tuple(column.name for column in table.columns),
        decimals=table.decimals,
        lines=_grouped(_merged(theirs, ours)),
        notes=(*table.notes, *_notes(runs, table.rows), *_peer_notes()),
    )


def _alone(benchmark: str, runs: Sequence[Run]) -> Filled:
    lines = [
        TableLine(
            name,
            tuple(_cell(run_of[benchmark], measure) for measure in metrics.MEASURES),
            source,
            group_of([run_of[benchmark]]),
        )
        for name, source, run_of in _systems(runs, ())
    ]
    return Filled(benchmark, tuple(metrics.MEASURES.values()), 2, _grouped(lines), tuple(_notes(runs, ())))


def group_of(runs: Sequence[Run], table: Table | None = None, name: str = "") -> str:
    """Which of `published.GROUPS` a system is in, by the leaks of its runs and the published row of its name."""
    leaks = [run.manifest.leaks for run in runs]
    if any("yes" in (leak["truth"], leak["shared"]) for leak in leaks):
        return "truth"
    if any(leak["trained"] == "yes" for leak in leaks):
        return "trained"
    if table and name in table.rows:
        return table.group(name)
    declared = all(leak["trained"] == "no" for leak in leaks)
    return "training-free" if declared or not any(run.external for run in runs) else "undeclared"


def _grouped(lines: Iterable[TableLine]) -> tuple[TableLine, ...]:
    order = list(published.GROUPS)
    return tuple(sorted(lines, key=lambda line: order.index(line.group)))


def _peer_notes() -> list[str]:
    """Systems named without numbers, one line for each group."""
    return [
        f"Not in this table, {heading}: "
        + "; ".join(f"{peer.name} ({peer.source}: {peer.note})" for peer in published.peers() if peer.group == group)
        + "."
        for group, heading in published.GROUPS.items()
        if any(peer.group == group for peer in published.peers())
    ]


def _systems(runs: Iterable[Run], names: Container[str]) -> list[tuple[str, Source, dict[str, Run]]]:
    """(label, source, run by benchmark) of each system; a second run on one benchmark starts another row.

    The label is the first of the system's labels that is among a table's `names`, else its latest.
    """
    rows: list[tuple[str, str, Source, dict[str, Run]]] = []
    for run in runs:
        system = run.manifest.system
        row = next((found for key, _, _, found in rows if key == system and _benchmark(run) not in found), None)
        if row is None:
            row = {}
            source: Source = "scored here" if run.external else "ours"
            rows.append((system, _label(run, names), source, row))
        row[_benchmark(run)] = run
    return [(label, source, row) for _, label, source, row in rows]


def _label(run: Run, names: Container[str]) -> str:
    if run.manifest.label in names or run.manifest.identity.get("oracle"):
        return run.manifest.label
    return next((label for label in run.manifest.labels if label in names), run.manifest.label)


def _merged(theirs: Sequence[TableLine], ours: Sequence[TableLine]) -> list[TableLine]:
    """Each of our rows below the published row of its name, the others at the end."""
    left = list(ours)
    lines: list[TableLine] = []
    for line in theirs:
        lines.append(line)
        same = [own for own in left if own.name == line.name or (own.name == "paper" and line.name == OURS)]
        lines += same
        left = [own for own in left if own not in same]
    return lines + left


def _cell(run: Run | None, measure: str) -> Cell:
    if run is None:
        return Cell(None)
    found = _scores(run)
    value = float(getattr(found, measure))
    if value != value:
        return Cell(None)
    low, high = found.intervals.get(measure, (float("nan"), float("nan")))
    return Cell(100 * value, 50 * (high - low) if high == high else None)


def _notes(runs: Iterable[Run], names: Container[str]) -> list[str]:
    """One note per run: protocol, samples, failures, leaks."""
    notes: list[str] = []
    for run in runs:
        found, selection = _scores(run), run.manifest.identity["selection"]
        part = f" of {run.planned} planned" if not run.complete else ""
        chosen = f", the first {selection['limit']}" if selection["limit"] else ""
        count = scores.statuses(run).get("abstained", 0)
        abstained = f", {count} abstained and scored as they are" if count else ""
        shuffled = f" after a shuffle with seed {selection['shuffle']}" if selection["shuffle"] is not None else ""
        notes.append(
            f"{_label(run, names)} on {_benchmark(run)} ({run.manifest.hash}): protocol {found.protocol},"
            f" {found.n} samples{part}{chosen}{shuffled}, {found.n_scored} scored, {found.n_failed} failed"
            f"{abstained}. "
            + "; ".join(f"{question}: {run.manifest.leaks[leak]}" for leak, question in LEAKS.items())
            + "."
        )
    return notes


@lru_cache(maxsize=64)
def _scores(run: Run) -> metrics.Scores:
    """The scores of a run, computed once: a row has several columns, and intervals take time."""
    return scores.score(run)


def _benchmark(run: Run) -> str:
    return str(run.manifest.identity["benchmark"])


def _number(cell: Cell, decimals: int, plus_minus: str) -> str:
    if cell.value is None:
        return "–"
    text = f"{cell.value:.{decimals}f}"
    return text if cell.half_width is None else f"{text} {plus_minus} {cell.half_width:.1f}"


def _with_headings(table: Filled) -> Iterable[tuple[TableLine, str]]:
    """The lines, each with the heading to print above it: its group's name where one of several groups begins."""
    several = len({line.group for line in table.lines}) > 1
    before = ""
    for line in table.lines:
        yield line, published.GROUPS[line.group] if several and line.group != before else ""
        before = line.group


def _markdown(table: Filled) -> str:
    def escaped(text: str) -> str:
        return text.replace("\\", "\\\\").replace("|", "\\|")

    rows = [["Model", *table.columns]]
    for line, heading in _with_headings(table):
        if heading:
            rows.append([f"*{heading}*", *([""] * len(table.columns))])
        name = escaped(line.name) if line.source == "published" else f"**{escaped(line.name)}** ({line.source})"
        rows.append([name, *(_number(cell, table.decimals, "±") for cell in line.cells)])
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = [
        "| "
        + " | ".join([row[0].ljust(widths[0]), *(v.rjust(w) for v, w in zip(row[1:], widths[1:], strict=True))])
        + " |"
        for row in rows
    ]
    rule = "|" + "|".join(["-" * (widths[0] + 2), *("-" * (width + 1) + ":" for width in widths[1:])]) + "|"
    notes = [f"- {escaped(note)}" for note in table.notes]
    return "\n".join([f"### {table.title}", "", lines[0], rule, *lines[1:], "", *notes]).rstrip() + "\n"


def _latex(table: Filled) -> str:
    def escaped(text: str) -> str:
        marks = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "–": "--"}
        return "".join(marks.get(c, f"\\{c}" if c in "&%$#_{}" else c) for c in text)

    lines = [f"% {note}" for note in table.notes]
    lines += [
        r"\begin{table}[t]",
        r"  \centering",
        f"  \\caption{{{escaped(table.title)}}}",
        f"  \\begin{{tabular}}{{l{'r' * len(table.columns)}}}",
        r"    \toprule",
        "    " + " & ".join(["Model", *map(escaped, table.columns)]) + r" \\",
        r"    \midrule",
    ]
    for line, heading in _with_headings(table):
        if heading:
            lines.append(f"    \\multicolumn{{{len(table.columns) + 1}}}{{l}}{{\\emph{{{escaped(heading)}}}}} \\\\")
        bold = f"\\textbf{{{escaped(line.name)}}} ({line.source})"
        name = escaped(line.name) if line.source == "published" else bold
        cells = [_number(cell, table.decimals, r"$\pm$").replace("–", "--") for cell in line.cells]
        lines.append("    " + " & ".join([name, *cells]) + r" \\")
    return "\n".join([*lines, r"    \bottomrule", r"  \end{tabular}", r"\end{table}"]) + "\n"


def _csv(table: Filled) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["table", "model", "source", "group", *(part for c in table.columns for part in (c, f"{c} 95% half width"))]
    )
    for line in table.lines:
        cells = [
            "" if value is None else f"{value:.{table.decimals}f}"
            for cell in line.cells
            for value in (cell.value, cell.half_width)
        ]
        writer.writerow([table.title, line.name, line.source, line.group, *cells])
    return text.getvalue()
