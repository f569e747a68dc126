"""How fast 3,000 masks of 1920 x 1080 are scored, and in how much memory.

    python perf/metrics.py [--masks 3000]

Four ways in, each from mask to `Scores` with its intervals: arrays that are already in memory, COCO RLE for both
sides (as a run keeps them), PNG predictions against PNG truths (as `a4 score` reads them), and the same kept as a run
(`a4 score --out`). The last two also print how often a true mask was read: once a sample.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from a4agent.benchmarks.base import Benchmark, Sample
from a4agent.benchmarks.predictions import Predictions
from a4agent.benchmarks.registry import load
from a4agent.imaging.masks import decode_rle, encode_rle
from a4agent.metrics import Row, measure, score
from a4agent.runs.external import score_predictions, write_run

WIDTH, HEIGHT, DIFFERENT = 1920, 1080, 20


def blobs(generator: np.random.Generator) -> np.ndarray:
    """A mask of a few ellipses with a ragged edge, as segmenters make them."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    mask = np.zeros((HEIGHT, WIDTH), bool)
    for _ in range(3):
        cx, cy = generator.uniform(0.2, 0.8, 2) * (WIDTH, HEIGHT)
        rx, ry = generator.uniform(0.03, 0.2, 2) * (WIDTH, HEIGHT)
        angle = np.arctan2(y - cy, x - cx)
        edge = 1 + 0.05 * np.sin(angle * generator.integers(5, 40))
        mask |= ((x - cx) / rx) ** 2 + ((y - cy) / ry) ** 2 < edge
    return mask


def timed(name: str, count: int, rows: Callable[[], Iterator[Row]]) -> None:
    before, started, worked = _peak_mib(), time.perf_counter(), time.process_time()
    scores = score(rows())
    seconds, worked = time.perf_counter() - started, time.process_time() - worked
    print(
        f"{name:<22} {count} masks in {seconds:6.2f} s ({worked:.2f} s of CPU, {1000 * worked / count:.2f} ms each), "
        f"peak memory {_peak_mib():.0f} MiB (+{_peak_mib() - before:.0f}), gIoU {scores.giou:.4f}"
    )


def _peak_mib() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--masks", type=int, default=3000)
    count = parser.parse_args().masks
    generator = np.random.default_rng(0)
    masks = [blobs(generator) for _ in range(DIFFERENT)]
    encoded = [encode_rle(mask) for mask in masks]
    pairs = [(i % DIFFERENT, (i + 1 + i // DIFFERENT) % DIFFERENT) for i in range(count)]

    timed("arrays", count, lambda: (measure(masks[one], masks[two]) for one, two in pairs))
    timed("COCO RLE", count, lambda: (measure(decode_rle(encoded[a]), decode_rle(encoded[b])) for a, b in pairs))
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        (root / "predictions").mkdir()
        for number, mask in enumerate(masks):
            Image.fromarray(mask.astype(np.uint8) * 255).save(root / f"truth{number}.png")
        lines: list[str] = []
        for number, (prediction, other) in enumerate(pairs):
            shutil.copy(root / f"truth{prediction}.png", root / "predictions" / f"{number}.png")
            truth = f"truth{other}.png"
            lines.append(json.dumps({"id": str(number), "image": truth, "mask": truth, "instruction": "x"}))
        (root / "samples.jsonl").write_text("\n".join(lines))
        data, reads = counted(load("folder", root))
        predictions = Predictions(root / "predictions")
        timed("PNG files (a4 score)", count, lambda: (one.row for one in score_predictions(data, predictions)))
        print(f"{'':<22} {len(reads)} true masks read for {count} samples")
        reads.clear()
        kept = partial(write_run, data, predictions, root / "run", name="theirs")
        timed("kept (a4 score --out)", count, lambda: (record.scored for record in kept().records.values()))
        print(f"{'':<22} {len(reads)} true masks read for {count} samples")


def counted(benchmark: Benchmark) -> tuple[Benchmark, list[str]]:
    """The same benchmark, and a list that grows by an id whenever a true mask is read."""
    reads: list[str] = []

    def sample(index: int) -> Sample:
        plain = benchmark[index]

        def load_mask() -> np.ndarray:
            reads.append(plain.id)
            return plain.truth.mask()

        return replace(plain, truth=replace(plain.truth, load_mask=load_mask))

    return replace(benchmark, sample=sample), reads


if __name__ == "__main__":
    main()
