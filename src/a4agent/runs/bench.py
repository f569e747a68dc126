"""Score an agent on a benchmark, into a run folder.

    work = Bench(benchmark, settings, selection=Selection(limit=100))
    with A4Agent.from_settings(settings) as agent:
        run = work.run(agent)

The agent sees queries only; the truth stays here.
"""

from __future__ import annotations

import hashlib
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image as Pillow
from PIL.Image import Image

from a4agent import engine, metrics
from a4agent.agent import A4Agent
from a4agent.benchmarks.base import Benchmark, Sample
from a4agent.config import Settings
from a4agent.errors import DataError, InputError, UserError
from a4agent.imaging.masks import Rle, decode_rle, encode_rle
from a4agent.plugins import Plugins
from a4agent.runs.manifest import Manifest, prompt_hashes, settings_identity, settings_shown
from a4agent.runs.oracle import Oracle, given_of
from a4agent.runs.store import Record, Run, RunWriter, read_run
from a4agent.types import Affordance, Given, Query, Status, finite_or_none

RUNS = Path("runs")
ENGINES = Plugins("a4agent.engines", "engine", "'local' runs in this process.")


@dataclass(frozen=True)
class Selection:
    """Which samples of a benchmark: the first `limit`, after a shuffle if `shuffle` gives its seed."""

    limit: int | None = None
    shuffle: int | None = None

    def indices(self, size: int) -> list[int]:
        """Positions in the benchmark, in the order of asking; the same on every machine."""
        chosen = list(range(size))
        if self.shuffle is not None:
            chosen.sort(key=lambda i: hashlib.sha256(f"{self.shuffle} {i}".encode()).digest())
        return chosen[: self.limit]


@dataclass
class Progress:
    """How far a run has come: `scored` of `planned` samples have a record, `failed` of them are invalid or errors.

    This session has `asked` for that many of its `to_ask` samples, at a `cost` in US dollars. `unscored` maps samples
    that cannot have a record (refused row, unreadable truth) to the reason.
    """

    planned: int
    to_ask: int
    scored: int = 0
    failed: int = 0
    cost: float = 0.0
    asked: int = 0
    unscored: dict[str, str] = field(default_factory=dict[str, str])
    stats: engine.Stats = field(default_factory=engine.Stats)
    _iou: float = 0.0
    _counted: int = 0

    @property
    def left(self) -> int:
        """How many samples this session may still ask for."""
        return max(self.to_ask - self.asked - len(self.unscored), 0)

    @property
    def giou(self) -> float:
        """gIoU of the samples so far; NaN before the first."""
        return self._iou / self._counted if self._counted else float("nan")

    def count(self, row: metrics.Row, protocol: str, sign: int = 1) -> None:
        """Add a row, or with `sign=-1` take back one that is replaced."""
        self.scored += sign
        self.failed += sign * row.failed
        value = metrics.iou(row, protocol)
        if value is not None:
            self._iou += sign * value
            self._counted += sign


@dataclass(frozen=True)
class Bench:
    """One configuration on one benchmark.

    `retry` names the statuses to ask for again; `leaks` answers questions of `manifest.LEAKS`.
    """

    benchmark: Benchmark
    settings: Settings
    selection: Selection = Selection()
    protocol: str | None = None
    oracle: Oracle | None = None
    label: str = ""
    out: Path | None = None
    retry: tuple[Status, ...] = ()
    leaks: Mapping[str, str] = field(default_factory=dict[str, str])
    engine: Literal["local", "ray"] = "local"

    def manifest(self, agent: A4Agent) -> Manifest:
        """What decides the answers of this run."""
        return Manifest(
            identity={
                **data_identity(self.benchmark, self.selection, self.protocol),
                "oracle": self.oracle,
                "settings": settings_identity(self.settings),
                "experts": [dict(expert.fingerprint()) for expert in agent.experts()],
                "prompts": prompt_hashes(self.settings),
            },
            about={
                "profile": self.settings.name,
                "label": self.label,
                **data_about(self.benchmark),
                "settings": settings_shown(self.settings),
                **({"leaks": dict(self.leaks)} if self.leaks else {}),
            },
        )

    def folder(self, manifest: Manifest) -> Path:
        """The run folder: `out`, or one named by benchmark, profile and configuration."""
        oracle = f"-oracle-{self.oracle}" if self.oracle else ""
        return self.out or RUNS / f"{self.benchmark.name}-{self.settings.name}{oracle}-{manifest.hash}"

    @contextmanager
    def open(self, agent: A4Agent) -> Generator[Session, None, None]:
        """Lock the run folder; iterate over the session to ask for the missing samples.

        Raises:
            ConfigError: the folder belongs to another configuration.
            DataError: another process is writing it.
        """
        manifest = self.manifest(agent)
        with RunWriter(self.folder(manifest), manifest, self.retry) as writer:
            yield Session(self, agent, writer)

    def run(self, agent: A4Agent) -> Run:
        """Ask for every missing sample and return the run. Raises like `Session`."""
        with self.open(agent) as session:
            for _ in session:
                pass
        return read_run(session.folder)


def data_identity(benchmark: Benchmark, selection: Selection, protocol: str | None) -> dict[str, Any]:
    """The part of a manifest's identity that says what is asked and how it is scored."""
    samples = len(selection.indices(len(benchmark)))
    return {
        "benchmark": benchmark.name,
        "data": benchmark.fingerprint(),
        "selection": {"limit": selection.limit, "shuffle": selection.shuffle, "samples": samples},
        "protocol": metrics.protocol_of(protocol or benchmark.protocol).name,
    }


def data_about(benchmark: Benchmark) -> dict[str, str]:
    """Where the data was and under which licence, for a manifest's `about`."""
    return {"data": str(benchmark.root), "licence": benchmark.licence}


class Session:
    """One start on a run folder. Iterate for a record per sample; `progress.unscored` names samples without one.

    Raises, while iterating:
        BudgetExceeded, UserError, ProviderError: see `engine.run`; answers so far are kept.
        KeyboardInterrupt: Ctrl-C; answers in flight are kept too.
    """

    def __init__(self, work: Bench, agent: A4Agent, writer: RunWriter) -> None:
        self.folder = writer.folder
        self._work = work
        self._agent = agent
        self._writer = writer
        self._indices = work.selection.indices(len(work.benchmark))
        self._protocol = str(writer.manifest.identity["protocol"])
        self.progress = Progress(len(self._indices), len(self._indices) - writer.settled)
        for record in writer.records.values():
            self.progress.count(record.scored, self._protocol)

    def __iter__(self) -> Iterator[Record]:
        progress, writer, benchmark = self.progress, self._writer, self._work.benchmark
        for asked, affordance in self._answers():
            progress.asked += 1
            progress.cost += affordance.trace.cost
            row = row_of(benchmark, asked.sample, affordance, asked.truths(), writer)
            if row["id"] in writer.records:
                progress.count(writer.records[row["id"]].scored, self._protocol, -1)
            record = writer.add(row)
            progress.count(record.scored, self._protocol)
            yield record

    def _answers(self) -> Iterator[tuple[_Asked, Affordance]]:
        """The missing samples with their answers, as they finish."""
        benchmark, oracle = self._work.benchmark, self._work.oracle
        in_flight: dict[str, _Asked] = {}
        seen: set[str] = set()

        def queries() -> Iterator[Query]:
            for index in self._indices:
                try:
                    sample = benchmark[index]
                except UserError as error:  # a refused row, such as one with a picture outside the dataset
                    self.progress.unscored[f"sample {index}"] = str(error)
                    continue
                if sample.id in seen:
                    raise DataError(f"two samples of {benchmark.name!r} have the same id {sample.id!r}")
                seen.add(sample.id)
                if not self._writer.wants(sample.id):
                    continue
                try:  # before asking, so that nothing is paid for a sample that cannot be scored
                    in_flight[sample.id] = _Asked(sample, tuple(encode_rle(mask) for mask in sample.truth.masks()))
                except UserError as error:
                    self.progress.unscored[sample.id] = str(error)
                    continue
                yield sample.query

        def given(query: Query) -> Given | None:
            asked = in_flight[query.id]
            try:
                return given_of(asked.sample, oracle, asked.truths()[0]) if oracle else None
            except InputError:
                return None  # the agent fails on the same picture, and that is this sample's answer

        settings, stats = self._work.settings, self.progress.stats
        known = given if oracle else None
        if self._work.engine != "local":
            answers = ENGINES.find(self._work.engine)(settings, queries(), given=known, stats=stats)
        else:
            answers = engine.run(self._agent, queries(), settings=settings.engine, given=known, stats=stats)
        for query, affordance in answers:
            yield in_flight.pop(query.id), affordance


@dataclass(frozen=True)
class _Asked:
    """A sample in flight. Its true masks are read once and kept run-length encoded until the answer comes."""

    sample: Sample
    encoded: tuple[Rle, ...]

    def truths(self) -> tuple[np.ndarray, ...]:
        return tuple(decode_rle(rle) for rle in self.encoded)


def row_of(
    benchmark: Benchmark, sample: Sample, affordance: Affordance, truths: tuple[np.ndarray, ...], writer: RunWriter
) -> dict[str, Any]:
    """The line of samples.jsonl: the answer, its score, and the names of its pictures, which are written too.

    `truths` are masks (H, W) of bool that are equally right.
    """
    mask = affordance.mask
    row, best = metrics.measure_best(mask, truths, affordance.status)
    measures = {"contact": metrics.contact_hit(None if row.failed else mask, truths)}
    if benchmark.measure:
        measures |= benchmark.measure(sample, affordance)
    imagined = affordance.imagination.image if affordance.imagination else None
    pictures = {"original": affordance.image, "imagination": imagined}
    names = {kind: writer.add_picture(image) for kind, image in pictures.items() if image is not None}
    if benchmark.frames and (frames := benchmark.frames(sample)):
        names |= {"frames": writer.add_picture(strip(frames)), "animation": writer.add_animation(frames)}
    answer = replace(affordance, id=sample.id).to_dict()
    for region in answer["regions"]:
        region["score"] = finite_or_none(region["score"])
    return {
        **answer,
        "intersection": row.intersection,
        "union": row.union,
        "iou": metrics.iou(row),
        "truth_pixels": row.truth_pixels,
        "prediction_pixels": row.prediction_pixels,
        "resized": row.resized,
        "measures": {name: finite_or_none(value) for name, value in measures.items()},
        "truth": encode_rle(truths[best]),
        "category": sample.truth.category,
        "tags": dict(sample.truth.tags),
        "pictures": names,
    }


def strip(frames: Sequence[Image]) -> Image:
    """The first, the last and two frames between them, side by side."""
    chosen = [frames[round(i * (len(frames) - 1) / 3)] for i in range(4)]
    width, height = chosen[0].size
    joined = Pillow.new("RGB", (4 * width, height))
    for place, frame in enumerate(chosen):
        joined.paste(frame, (place * width, 0))
    return joined
