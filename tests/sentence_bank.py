"""The bank of sentences: rows of `sentences.tsv`, and when two answers mean the same part of the same thing."""

from __future__ import annotations

import csv
import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

from a4agent.offline.decisions import decide
from a4agent.offline.knowledge import knowledge, stem
from a4agent.offline.phrases import Wanted, wanted

FILE = Path(__file__).parent / "offline" / "sentences.tsv"


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
        answer = decide(self.sentence, self.seen).phrase
        wished = " | ".join(self.answers)
        return f"{self.kind}: {self.sentence!r} {list(self.seen)}: {answer!r}, not {wished!r}"


def read(path: Path = FILE) -> list[Row]:
    """The rows of a tab-separated file of sentences."""
    with path.open(encoding="utf-8") as lines:
        return [
            Row(row["kind"], _split(row["seen"], ","), row["sentence"], _split(row["answers"], "|"))
            for row in csv.DictReader(lines, delimiter="\t", quoting=csv.QUOTE_NONE)
        ]


def _split(text: str | None, mark: str) -> tuple[str, ...]:
    return tuple(item.strip() for item in (text or "").split(mark) if item.strip())


def same(answer: str, wished: str, *, qualifiers: bool = True) -> bool:
    """Whether two phrases mean the same part of the same thing, whatever names are used for them."""
    return bool(answer) and (answer == wished or _meaning(answer, qualifiers) == _meaning(wished, qualifiers))


def _meaning(phrase: str, qualifiers: bool) -> tuple[str, str, Wanted]:
    part, _, owner = phrase.removeprefix("the ").partition(" of the ")
    read_as = wanted(phrase)
    if not qualifiers:
        read_as = replace(read_as, colour=None, side=None, size=None, part_colour=None, part_side=None)
    if read_as.object is None:
        return " ".join(stem(part)), " ".join(stem(owner)), read_as
    thing = knowledge().objects[read_as.object]
    names = (thing.part_named(" ".join(part.split()[start:])) for start in range(len(part.split())))
    named = next((known.name for known in names if known), part)
    return named, "", read_as
