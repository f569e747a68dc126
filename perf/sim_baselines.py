"""What the simulator benchmark asks of a system, as baselines: the table of docs/sim.md.

    python perf/sim_baselines.py [--data DIR] [--limit N] [--profile offline]

Without --data: the default set of 200, made in the cache at first use. Printed as Markdown, with 95 %
intervals, and the profile's scores by each tag of the samples:

    the whole object                    the mask of the object that the part belongs to
    a random part                       one side of a random straight cut through the object
    the profile                         its own thinking, detection and masks
    its segmenter, told the boxes       as if its Thinker and Detector were perfect
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from a4agent import A4Agent, metrics
from a4agent.benchmarks import files
from a4agent.benchmarks.base import Sample
from a4agent.metrics import Row
from a4agent.runs.oracle import given_of
from a4agent.sim import benchmark as sim
from a4agent.types import Given, Status


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--data", type=Path, help="a set that `a4 data make sim` wrote")
    parser.add_argument("--limit", type=int, help="only the first N samples")
    parser.add_argument("--profile", default="offline")
    arguments = parser.parse_args()

    benchmark = sim.create(arguments.data)
    samples = [benchmark[index] for index in range(min(arguments.limit or len(benchmark), len(benchmark)))]
    objects = [files.read_mask(benchmark.root / row.object_mask) for row in sim.read_rows(benchmark.root)]
    pairs = list(zip(samples, objects, strict=False))
    rng = np.random.default_rng(0)

    print(f"{benchmark.name}, {len(samples)} samples, {benchmark.options}\n")
    print("| system | gIoU | cIoU | P@50 | P@50:95 | failed |\n|---|---|---|---|---|---|")
    print(line("the whole object", [measure(sample, whole) for sample, whole in pairs]))
    print(line("a random part", [measure(sample, random_part(whole, rng)) for sample, whole in pairs]))
    with A4Agent.from_profile(arguments.profile) as agent:
        asked = [ask(agent, sample, None) for sample in samples]
        print(line(f"`{arguments.profile}`", asked))
        told = [ask(agent, sample, given_of(sample, "detector", sample.truth.mask())) for sample in samples]
        print(line(f"`{arguments.profile}`'s segmenter, told the boxes", told))

    print("\n| tag | value | samples | gIoU | P@50 |\n|---|---|---|---|---|")
    for tag in samples[0].truth.tags:
        values = [sample.truth.tags[tag] for sample in samples]
        for value, scores in sorted(metrics.score_by(asked, values).items()):
            print(f"| {tag} | {value} | {scores.n} | {cell(scores, 'giou')} | {cell(scores, 'p50')} |")


def ask(agent: A4Agent, sample: Sample, given: Given | None) -> Row:
    affordance = agent.predict(sample.query.image, sample.query.instruction, given=given)
    return measure(sample, affordance.mask, affordance.status)


def measure(sample: Sample, mask: np.ndarray, status: Status = "ok") -> Row:
    return metrics.measure(mask, sample.truth.mask(), status, sample.truth.alternatives())


def random_part(whole: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The side of a random straight cut through a random pixel of the object (H, W) bool."""
    rows, columns = np.nonzero(whole)
    through = rng.integers(len(rows))
    angle = rng.uniform(0, 2 * np.pi)
    side = (rows - rows[through]) * np.sin(angle) + (columns - columns[through]) * np.cos(angle) >= 0
    part = np.zeros_like(whole)
    part[rows[side], columns[side]] = True
    return part


def line(name: str, rows: list[Row]) -> str:
    scores = metrics.score(rows)
    cells = " | ".join(cell(scores, measure) for measure in ("giou", "ciou", "p50", "p50_95"))
    return f"| {name} | {cells} | {scores.n_failed} |"


def cell(scores: metrics.Scores, measure: str) -> str:
    low, high = scores.intervals[measure]
    return f"{100 * getattr(scores, measure):.1f} ({100 * low:.1f} to {100 * high:.1f})"


if __name__ == "__main__":
    main()
