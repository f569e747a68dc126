"""A benchmark: samples with a public half and a hidden one.

    benchmark = load("folder", "photos")            # benchmarks.registry
    for sample in benchmark:                        # streams; nothing is decoded before it is asked for
        affordance = agent.predict(sample.query.image, sample.query.instruction)
        row = metrics.measure(affordance.mask, sample.truth.mask(), affordance.status)

An agent gets only `sample.query`: an id, a picture, an instruction. Masks, part names, reference answers and
categories are in `sample.truth`, which only the scorer sees.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL.Image import Image

from a4agent.types import Affordance, Query


@dataclass(frozen=True, eq=False)
class Truth:
    """The hidden half of a sample.

    `load_mask` reads the mask when it is wanted. The words are "" where the dataset has none:
    `object_part` is the phrase a perfect Thinker would answer ("the handle of the mug"), `category` is
    what scores are broken down by, `affordance` the verb asked for, `answer` the dataset's reference text;
    `tags` are further things to break scores down by, as {"size": "small"}.

    `load_alternatives` is for questions with several right answers ("open one of the drawers"): masks that
    are each as right as the one of `load_mask`.
    """

    load_mask: Callable[[], np.ndarray] = field(repr=False)
    object_name: str = ""
    object_part: str = ""
    affordance: str = ""
    category: str = ""
    answer: str = ""
    tags: Mapping[str, str] = field(default_factory=dict)
    load_alternatives: Callable[[], tuple[np.ndarray, ...]] | None = field(default=None, repr=False)

    def mask(self) -> np.ndarray:
        """The true mask, (H, W) bool, read anew at every call.

        Raises:
            DataError: the file is missing, outside the dataset's folder or cannot be read.
        """
        return self.load_mask()

    def alternatives(self) -> tuple[np.ndarray, ...]:
        """Other masks (H, W) bool that are as right as `mask()`; for `metrics.measure`. Usually none."""
        return self.load_alternatives() if self.load_alternatives else ()

    def masks(self) -> tuple[np.ndarray, ...]:
        """All masks (H, W) bool that are equally right: that of `mask()`, then `alternatives()`."""
        return self.mask(), *self.alternatives()


@dataclass(frozen=True, eq=False)
class Sample:
    """One question and its hidden answer."""

    query: Query
    truth: Truth

    @property
    def id(self) -> str:
        return self.query.id


@dataclass(frozen=True, eq=False)
class Benchmark:
    """An opened dataset: `len(benchmark)` samples, `benchmark[i]` or iteration makes them one at a time.

    What a reader's `create(path, *, option=...)` returns, and all that it has to fill in:

    name, licence, source: what it is called, under which terms, and where to get what is missing.
    root: the folder that holds the data; nothing outside is read.
    size, sample: how many samples there are, and the i-th of them (lazily: no picture is decoded).
    digest: a sha256 over the index and the files' names and sizes: two datasets that differ differ here.
    options: the reader's options that decide what is asked or true, such as UMD's `rule`.
    revision: the dataset's own name for its version, "" if it has none.
    protocol: how it is scored by default; published_protocol: how its authors' code scores it.
    expected: the published number of samples, None if there is no such number.
    measure: further measures of one answer by name, where the field uses other ones; their means are printed.
    frames: pictures of one size that show what an answer led to, or none; called after `measure` of the same sample.
    """

    name: str
    licence: str
    source: str
    root: Path
    size: int
    sample: Callable[[int], Sample] = field(repr=False)
    digest: str
    options: Mapping[str, Any] = field(default_factory=dict)
    revision: str = ""
    protocol: str = "strict"
    published_protocol: str = "strict"
    expected: int | None = None
    measure: Callable[[Sample, Affordance], Mapping[str, float]] | None = field(default=None, repr=False)
    frames: Callable[[Sample], Sequence[Image]] | None = field(default=None, repr=False)

    def __len__(self) -> int:
        return self.size

    def __getitem__(self, index: int) -> Sample:
        if not 0 <= index < self.size:
            raise IndexError(index)
        return self.sample(index)

    def __iter__(self) -> Iterator[Sample]:
        return (self.sample(index) for index in range(self.size))

    def fingerprint(self) -> dict[str, Any]:
        """What a run's manifest keeps, ready for `json.dumps`: equal for equal questions and truths only."""
        return {
            "benchmark": self.name,
            "options": dict(self.options),
            "revision": self.revision,
            "rows": self.size,
            "sha256": self.digest,
        }
