"""The tables of docs/acting.md from runs of `a4 bench sim-act`: success by where the contact came from.

    python perf/sim_act.py "the true part=runs/sim-act-truth" "offline=runs/sim-act-offline"

Folders after one name, separated by commas, count as one run.
"""

from __future__ import annotations

import sys
from math import sqrt
from pathlib import Path

from a4agent.runs.store import Record, read_run
from a4agent.sim.act_tasks import TASKS

Z = 1.959964
"""Of a two-sided interval of 95 %."""


def main(runs: dict[str, list[Record]]) -> None:
    """Print what all trials came to, then each task."""
    print(
        "| contact from | success | trials | lost: part, depth, control | contact error, median and 90th percentile |"
    )
    print("|---|---|---|---|---|")
    for name, records in runs.items():
        lost = ", ".join(str(_count(records, f"lost: {where}")) for where in ("part", "depth", "control"))
        errors = sorted(error for record in records if (error := record.measures["contact cm"]) is not None)
        ends = ", ".join(f"{errors[int(share * (len(errors) - 1))]:.1f} cm" for share in (0.5, 0.9)) if errors else ""
        succeeded = _count(records, "success")
        print(f"| {name} | {share_of(succeeded, len(records))} | {succeeded} of {len(records)} | {lost} | {ends} |")
    print()
    for name, records in runs.items():
        accepted = [record for record in records if record.measures["coverage"]]
        if len(accepted) < len(records):
            right = _count(accepted, "success")
            print(
                f"{name}: accepted {share_of(len(accepted), len(records))}, {len(accepted)} of {len(records)};", end=" "
            )
            print(f"success among them {share_of(right, len(accepted))}, {right} of {len(accepted)}\n")
    print(f"| task | {' | '.join(runs)} |")
    print("|---|" + "---|" * len(runs))
    for task in TASKS:
        of_task = [[record for record in records if record.category == task.name] for records in runs.values()]
        cells = [f"{_count(one, 'success')} of {len(one)}" for one in of_task]
        print(f"| {task.name} | {' | '.join(cells)} |")


def share_of(count: int, total: int) -> str:
    """A share in percent with its Wilson interval."""
    if not total:
        return "-"
    share, spread = count / total, Z * Z / total
    middle = (share + spread / 2) / (1 + spread)
    half = sqrt(share * (1 - share) * spread + spread * spread / 4) / (1 + spread)
    return f"{100 * share:.0f} % ({100 * (middle - half):.0f} to {100 * (middle + half):.0f})"


def _count(records: list[Record], measure: str) -> int:
    return sum(int(record.measures[measure] or 0) for record in records)


if __name__ == "__main__":
    named = [argument.partition("=") for argument in sys.argv[1:]]
    if not named or not all(folders for _, _, folders in named):
        sys.exit(__doc__)
    main(
        {
            name: [record for one in folders.split(",") for record in read_run(Path(one)).records.values()]
            for name, _, folders in named
        }
    )
