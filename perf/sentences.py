"""How many sentences the offline Thinker reads as a person would, by kind.

    python perf/sentences.py [--failures] [--file tests/offline/sentences.tsv]

Each row of the file names a kind, the things in the picture (may be blank), a sentence and the answers that a person
would give, separated by "|"; no answer means that the sentence must be refused. A sentence belongs to the held-out
half by its hash; `--failures` lists what goes wrong in the other half only.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from pathlib import Path

sys.path.append(str(Path(__file__).parent.parent / "tests"))

from sentence_bank import FILE, read


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--file", type=Path, default=FILE)
    parser.add_argument("--failures", action="store_true", help="list what goes wrong in the half that may be tuned on")
    arguments = parser.parse_args()
    rows = read(arguments.file)
    started = time.perf_counter()
    right = {row: row.right() for row in rows}
    seconds = time.perf_counter() - started
    if arguments.failures:
        print(*(row.failure() for row in rows if not row.held_out and not right[row]), sep="\n")
    counts: dict[tuple[str, bool], Counter[bool]] = {}
    for row in rows:
        for kind in (row.kind, "all"):
            counts.setdefault((kind, row.held_out), Counter())[right[row]] += 1
    print(f"{'':20}{'tuned':>14}{'held out':>14}")
    for kind in [*dict.fromkeys(row.kind for row in rows), "all"]:
        cells = (counts.get((kind, held_out), Counter()) for held_out in (False, True))
        print(f"{kind:20}" + "".join(f"{c[True]:>5} of {c.total():<4}{_percent(c):>4}" for c in cells))
    print(f"{1000 * seconds / len(rows):.1f} ms a sentence")


def _percent(counts: Counter[bool]) -> str:
    return f"{100 * counts[True] / counts.total():.0f} %" if counts.total() else ""


if __name__ == "__main__":
    main()
