"""Opens every picture and mask of a benchmark and counts what is missing or broken."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from a4agent.benchmarks.base import Benchmark, Sample
from a4agent.errors import A4Error, DataError
from a4agent.imaging.load import load_image

Kind = Literal["image missing", "image broken", "mask missing", "mask broken", "refused"]


@dataclass(frozen=True)
class Problem:
    """One sample that cannot be asked or scored, and why."""

    id: str
    kind: Kind
    message: str


@dataclass(frozen=True)
class DataCheck:
    """What `check` found. `other_size` counts masks whose size is not their picture's (they are scored as they are)."""

    rows: int
    expected: int | None
    readable: int
    empty_truths: int
    other_size: int
    problems: tuple[Problem, ...]
    categories: dict[str, int]

    @property
    def ok(self) -> bool:
        """Every sample can be asked and scored, and there are as many as were published."""
        return not self.problems and self.rows == (self.expected or self.rows) > 0

    def count(self, kind: Kind) -> int:
        return sum(problem.kind == kind for problem in self.problems)

    def to_dict(self) -> dict[str, Any]:
        """Ready for `json.dumps`."""
        return asdict(self) | {"ok": self.ok}


def check(benchmark: Benchmark, on_sample: Callable[[int], None] | None = None) -> DataCheck:
    """Read a benchmark, one sample at a time. `on_sample` is called with the number of each sample when it is done."""
    problems: list[Problem] = []
    categories: Counter[str] = Counter()
    readable = empty = other_size = 0
    picture: tuple[Path, tuple[int, int]] | None = None
    for number in range(len(benchmark)):
        try:
            sample = benchmark[number]
        except A4Error as error:
            problems.append(Problem(f"sample {number}", "refused", str(error)))
            continue
        categories[sample.truth.category] += 1
        try:
            source = sample.query.image
            if picture is None or source != picture[0]:
                size_wh = load_image(source).size
                picture = (source, size_wh) if isinstance(source, Path) else None
            else:
                size_wh = picture[1]
        except A4Error as error:
            picture = None
            problems.append(Problem(sample.id, "image missing" if _missing(error) else "image broken", str(error)))
            size_wh = None
        mask = _mask(sample, problems)
        if mask is not None:
            empty += not mask.any()
            other_size += size_wh is not None and mask.shape[::-1] != size_wh
            readable += size_wh is not None
        if on_sample:
            on_sample(number)
    return DataCheck(
        len(benchmark), benchmark.expected, readable, empty, other_size, tuple(problems), dict(categories.most_common())
    )


def _mask(sample: Sample, problems: list[Problem]) -> Any:
    try:
        return sample.truth.mask()
    except DataError as error:
        problems.append(Problem(sample.id, "mask missing" if _missing(error) else "mask broken", str(error)))
        return None


def _missing(error: A4Error) -> bool:
    return isinstance(error.__cause__, FileNotFoundError)
