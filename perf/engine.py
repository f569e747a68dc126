"""What the engine gains and costs, side by side with a plain loop over the same agent.

    python perf/engine.py                    overlap, overhead, cache (about 55 s)
    python perf/engine.py --memory           and the memory of a run of 100,000 samples (a minute or two more)
    python perf/engine.py --ray              500 photographs of 1280 x 960 through Ray actors on this machine alone

The experts sleep for the stage times of the published pipeline, divided by `--scale` (paper section 4.1; public
timings of the models on one H100-class GPU): editor 25 s, Thinker 10 s, prompt writing 3 s, detector 3.5 s,
SAM 2.1 large 0.1 s. Goals: wall time within 1.05 of the slowest stage's busy time; under 2 ms a sample with
experts that take no time; under 50 MiB of growth.
"""

from __future__ import annotations

import argparse
import gc
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from a4agent import engine
from a4agent.agent import A4Agent
from a4agent.engine import EngineSettings, Stats
from a4agent.protocols import ChatRequest
from a4agent.stages.dreamer import Dreamer
from a4agent.stages.spotter import Spotter
from a4agent.stages.thinker import Thinker
from a4agent.testing import ScriptedDetector, ScriptedEditor, ScriptedSegmenter, ScriptedVLM, output, scripted_agent
from a4agent.types import Query

SECONDS = {"writer": 3.0, "editor": 25.0, "thinker": 10.0, "detector": 3.5, "segmenter": 0.1}


def sleeping_agent(
    scale: float, *, segmenter: str = "sam2:large", thinker: str = "gpt-4o", editors: int = 1, dream: bool = True
) -> A4Agent:
    """The paper's pipeline, asleep: each stage on a machine of its own."""

    def answer(request: ChatRequest) -> str:
        return output("the handle") if "### Output" in request.text else f"Edit it: {request.text[-40:]}"

    seconds = {name: value / scale for name, value in SECONDS.items()}
    return A4Agent(
        Dreamer(
            ScriptedVLM(answer, id="gpt-4o writing", seconds=seconds["writer"]),
            ScriptedEditor(id="qwen-image-edit", seconds=seconds["editor"], concurrency=editors),
        )
        if dream
        else None,
        Thinker(ScriptedVLM(answer, id=thinker, seconds=seconds["thinker"])),
        Spotter(
            ScriptedDetector(id="rex-omni", seconds=seconds["detector"]),
            ScriptedSegmenter(id=segmenter, seconds=seconds["segmenter"]),
        ),
    )


def queries(count: int) -> Iterator[Query]:
    for number in range(count):
        picture = np.zeros((48, 64, 3), np.uint8)
        picture[0, 0] = number % 256, number // 256 % 256, number // 65536
        yield Query(str(number), picture, f"use thing {number}")


def loop(agent: A4Agent, count: int) -> float:
    started = time.perf_counter()
    for query in queries(count):
        agent.predict(query.image, query.instruction)
    return time.perf_counter() - started


def run(agent: A4Agent, count: int, settings: EngineSettings | None = None) -> tuple[float, Stats]:
    stats = Stats()
    started = time.perf_counter()
    for _ in engine.run(agent, queries(count), settings=settings, stats=stats):
        pass
    seconds = time.perf_counter() - started
    assert sum(stats.samples.values()) == stats.samples["ok"] == count, stats.samples
    return seconds, stats


def overlap(samples: int, scale: float) -> None:
    sequential = loop(sleeping_agent(scale), samples)
    wall, stats = run(sleeping_agent(scale), samples)
    for expert in stats.experts.values():
        print(f"  {expert.role:9} {expert.id:16} busy for {expert.seconds:6.2f} s")
    slowest = max(stats.experts.values(), key=lambda expert: expert.seconds)
    print(f"  plain loop {sequential:.2f} s, engine {wall:.2f} s: {sequential / wall:.2f} times as fast")
    print(f"  wall time / busy time of {slowest.id}: {wall / slowest.seconds:.3f} (goal 1.05)")
    wall4, _ = run(sleeping_agent(scale, editors=4), samples)
    print(f"  with four editors {wall4:.2f} s: {sequential / wall4:.2f} times as fast as the loop")


def overhead(samples: int) -> None:
    sequential = loop(scripted_agent(dream=True), samples)
    wall, _ = run(scripted_agent(dream=True), samples)
    print(f"  plain loop {1000 * sequential / samples:.3f} ms a sample, engine {1000 * wall / samples:.3f} ms a sample")
    print(f"  overhead {1000 * (wall - sequential) / samples:.3f} ms a sample (goal 2)")


def cache(samples: int, scale: float) -> None:
    """The paper's ablations after one another: each distinct call is made once."""
    variants: dict[str, dict[str, Any]] = {
        "the paper": {},
        "the paper again": {},
        "sam2:base-plus": {"segmenter": "sam2:base-plus"},
        "sam2:tiny": {"segmenter": "sam2:tiny"},
        "another Thinker": {"thinker": "qwen2.5-vl"},
        "without Dreamer": {"dream": False},
    }
    with tempfile.TemporaryDirectory() as folder:
        settings = EngineSettings(cache="write", cache_dir=Path(folder))
        made = saved = 0
        for name, changes in variants.items():
            seconds, stats = run(sleeping_agent(scale, **changes), samples, settings)
            made, saved = made + stats.asked, saved + stats.saved
            print(
                f"  {name:16} {seconds:6.2f} s ({1000 * seconds / samples:5.2f} ms a sample),"
                f" {stats.asked:4} calls made, {stats.saved:4} saved"
            )
        print(f"  together {made} calls made, {saved} saved")


def once(samples: int) -> None:
    """How often the pixels of a picture are hashed: for every key of the cache, or once."""
    from unittest.mock import patch

    from a4agent.imaging import load

    with (
        tempfile.TemporaryDirectory() as folder,
        patch("a4agent.engine.cache.image_hash", side_effect=load.image_hash) as wanted,
        patch.object(load, "_hash_pixels", side_effect=load._hash_pixels) as hashed,  # pyright: ignore[reportPrivateUsage]
    ):
        run(scripted_agent(dream=True), samples, EngineSettings(cache="write", cache_dir=Path(folder)))
    print(
        f"  {wanted.call_count} hashes wanted for the keys of {samples} samples, {hashed.call_count} computed", end=""
    )
    print(f": {hashed.call_count / wanted.call_count:.2f} of the work")


PLUGIN = """
from a4agent.testing import ScriptedDetector, ScriptedEditor, ScriptedSegmenter, ScriptedVLM, output

def create(model, role, *, seconds=0.0):
    if role == "vlm":
        answer = lambda request: output("the handle") if "### Output" in request.text else "Edit it."
        return ScriptedVLM(answer, id=f"asleep:{model}", seconds=seconds)
    kinds = {"editor": ScriptedEditor, "detector": ScriptedDetector, "segmenter": ScriptedSegmenter}
    return kinds[role](id=f"asleep:{model}", seconds=seconds)
"""
"""The sleeping experts as a package of their own: actors are other processes and find it by its entry point."""


def on_ray(samples: int, scale: float) -> None:
    """Whether the process that holds the agent keeps up with the slowest stage when every picture goes to actors."""
    from a4agent.config import Settings
    from a4agent.ray_engine import run as run_on_ray

    def asleep(name: str) -> dict[str, Any]:
        return {"expert": f"asleep:{name}", "seconds": SECONDS[name] / scale}

    with tempfile.TemporaryDirectory() as folder:
        info = Path(folder) / "asleep-1.0.dist-info"
        info.mkdir()
        (Path(folder) / "asleep.py").write_text(PLUGIN)
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: asleep\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text("[a4agent.experts]\nasleep = asleep:create\n")
        os.environ["PYTHONPATH"] = folder
        table = {
            "name": "asleep",
            "dreamer": {"vlm": asleep("writer"), "editor": asleep("editor")},
            "thinker": {"vlm": asleep("thinker")},
            "spotter": {"detector": asleep("detector"), "segmenter": asleep("segmenter")},
            "ray": {stage: {"num_cpus": 0.25} for stage in ("dreamer", "thinker", "spotter")},
        }
        random = np.random.default_rng(0)
        photographs = (random.integers(0, 255, (960, 1280, 3), np.uint8) for _ in range(samples))
        many = (Query(str(number), photograph, "open it") for number, photograph in enumerate(photographs))
        stats, first, ended = Stats(), 0.0, 0
        for _ in run_on_ray(Settings.model_validate(table), many, stats=stats):
            first, ended = first or time.perf_counter(), ended + 1
        wall, cpu = time.perf_counter() - first, time.process_time()
    assert stats.samples["ok"] == ended == samples, stats.samples
    editor = next(expert for expert in stats.experts.values() if expert.role == "editor")
    call, asleep_for = 1000 * editor.seconds / editor.batches, 1000 * SECONDS["editor"] / scale
    print(f"  {samples} photographs in {wall:.1f} s after the first, {1000 * wall / samples:.0f} ms each")
    print(f"  wall time / busy time of the editor: {wall / editor.seconds:.3f} (goal 1.05)")
    print(f"  a call of the editor takes {call:.0f} ms, {call - asleep_for:.0f} more than it sleeps")
    print(f"  this process used {1000 * cpu / samples:.0f} ms of CPU time a photograph")


def memory(samples: int) -> None:
    picture = Image.new("RGB", (64, 48))
    agent = scripted_agent()
    for expert in agent.experts():
        expert.requests = _Forgetful()  # type: ignore[attr-defined]
        expert.batches = _Forgetful()  # type: ignore[attr-defined]
    many = (Query(str(number), picture, "open it") for number in range(samples))
    started, first, highest = time.perf_counter(), 0.0, 0.0
    for done, _ in enumerate(engine.run(agent, many), 1):
        if done % 2000 == 0:
            gc.collect()
            now = _resident_mib()
            first = first or now
            highest = max(highest, now)
    seconds = time.perf_counter() - started
    print(f"  {samples} samples in {seconds:.1f} s ({1000 * seconds / samples:.3f} ms each)")
    print(f"  {first:.0f} MiB after 2,000 samples, {highest:.0f} MiB at most: {highest - first:+.1f} MiB (goal 50)")


class _Forgetful(list):  # pyright: ignore[reportMissingTypeArgument]
    """What a scripted expert keeps of its requests, not kept."""

    def append(self, item: object) -> None: ...
    def extend(self, items: object) -> None: ...


def _resident_mib() -> float:
    """This process's memory now, Linux only (elsewhere NaN)."""
    status = Path("/proc/self/statm")
    if not status.exists():
        return float("nan")
    return int(status.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=200, help="for the overlap and the cache")
    parser.add_argument("--scale", type=float, default=750.0, help="how many times as fast as life the experts sleep")
    parser.add_argument("--memory", action="store_true", help="also run 100,000 samples and watch the memory")
    parser.add_argument("--ray", action="store_true", help="run 500 photographs through Ray, and nothing else")
    options = parser.parse_args()
    if options.ray:
        print("Ray: experts that sleep in an actor for each stage, stage times / 250")
        on_ray(500, 250.0)
        return
    if options.memory:
        print("memory: experts that take no time")
        memory(100_000)
    print(f"overlap: {options.samples} samples, stage times / {options.scale:g}")
    overlap(options.samples, options.scale)
    print("overhead: experts that take no time, 5,000 samples")
    overhead(5000)
    print(f"once: {options.samples} samples, cache on")
    once(options.samples)
    print(f"cache: {options.samples} samples, stage times / {4 * options.scale:g}")
    cache(options.samples, 4 * options.scale)


if __name__ == "__main__":
    main()
