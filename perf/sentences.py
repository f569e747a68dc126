"""How many sentences the offline Thinker reads as a person would, by kind.

    python perf/sentences.py [--failures] [--file tests/offline/sentences.tsv]

Each row of the file names a kind, the things in the picture (may be blank), a sentence and the answers that a person
would give, separated by "|"; no answer means that the sentence must be refused. A sentence belongs to the held-out
half by its hash; `--failures` lists what goes wrong in the other half only.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from a4agent.offline.decisions import decide
from a4agent.offline.knowledge import knowledge, stem
from a4agent.offline.phrases import Wanted, wanted

FILE = Path(__file__).parents[1] / "tests" / "offline" / "sentences.tsv"


@dataclass(frozen=True)
class Row:
    """One sentence; `answers` are phrases, empty if it must be refused."""

    kind: str
    seen: tuple[str, ...]
    sentence: str
    answers: tuple[str, ...]

    @property
    def held_out(self) -> bool:
        return hashlib.sha256(self.sentence.encode()).digest()[0] % 2 == 0

    def right(self) -> bool:
        answer = decide(self.sentence, self.seen).phrase
        return any(same(answer, wished) for wished in self.answers) if self.answers else not answer

    def failure(self) -> str:
        return f"{self.kind}: {self.sentence!r} {list(self.seen)}: {decide(self.sentence, self.seen).phrase!r}, not {' | '.join(self.answers)!r}"


def read(path: Path = FILE) -> list[Row]:
    """The rows of a tab-separated file of sentences."""
    with path.open(encoding="utf-8") as lines:
        return [
            Row(row["kind"], _split(row["seen"], ","), row["sentence"], _split(row["answers"], "|"))
            for row in csv.DictReader(lines, delimiter="\t", quoting=csv.QUOTE_NONE)
        ]


def _split(text: str | None, mark: str) -> tuple[str, ...]:
    return tuple(item.strip() for item in (text or "").split(mark) if item.strip())


def same(answer: str, wished: str) -> bool:
    """Whether two phrases mean the same part of the same thing, whatever names are used for them."""
    return bool(answer) and (answer == wished or _meaning(answer) == _meaning(wished))


def _meaning(phrase: str) -> tuple[str, str, Wanted]:
    part, _, owner = phrase.removeprefix("the ").partition(" of the ")
    read_as = wanted(phrase)
    if read_as.object is None:
        return " ".join(stem(part)), " ".join(stem(owner)), read_as
    thing = knowledge().objects[read_as.object]
    names = (thing.part_named(" ".join(part.split()[start:])) for start in range(len(part.split())))
    named = next((known.name for known in names if known), part)
    return named, "", read_as


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
