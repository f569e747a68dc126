"""What a Verifier adds to a prediction's time, signal by signal.

    python perf/verifier.py [--profile offline] [--signal mirror ...] [--photo FILE "INSTRUCTION"] [--runs 7]

Each run predicts a picture that has not been seen before, so that nothing kept from the last one helps, and times
`Verifier.check` inside it: the rest of that prediction is what a Verifier's time is compared with, on the same
machine at the same moment. Without `--signal`, the profile's own signals are measured.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path
from typing import Any

from PIL import Image

from a4agent import A4Agent
from a4agent.stages.recorder import Recorder
from a4agent.stages.spotter import Spotter
from a4agent.stages.verifier import Verdict, Verifier
from a4agent.types import Affordance

COFFEE = Path(__file__).parents[1] / "examples" / "coffee.jpg"


def measure(agent: A4Agent, pictures: list[Image.Image], instruction: str) -> list[tuple[float, float]]:
    """Seconds of each prediction without its checks, and of the checks."""
    taken: list[float] = []
    check = Verifier.check

    def timed(self: Verifier, affordance: Affordance, spotter: Spotter, recorder: Recorder | None = None) -> Verdict:
        started = time.perf_counter()
        try:
            return check(self, affordance, spotter, recorder)
        finally:
            taken.append(time.perf_counter() - started)

    Verifier.check = timed
    try:
        found: list[tuple[float, float]] = []
        for picture in pictures:
            taken.clear()
            started = time.perf_counter()
            agent.predict(picture, instruction)
            whole = time.perf_counter() - started
            found.append((whole - sum(taken), sum(taken)))
        return found[1:]  # the first one loads the networks
    finally:
        Verifier.check = check


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--profile", default="offline")
    parser.add_argument("--signal", action="append", dest="signals", metavar="NAME", help="may be given again")
    parser.add_argument("--photo", nargs=2, default=[str(COFFEE), "fill the cup"], metavar=("FILE", "INSTRUCTION"))
    parser.add_argument("--runs", type=int, default=7)
    given = parser.parse_args()
    photo = Image.open(given.photo[0]).convert("RGB")
    photo.thumbnail((640, 640))
    pictures = [photo.rotate(angle, resample=Image.Resampling.BILINEAR) for angle in range(given.runs + 1)]
    sets: list[dict[str, Any]] = [{"verifier.signals": [s], "verifier.calibration": ""} for s in given.signals or ()]
    print(f"{'signals':24} {'prediction':>11} {'checks':>11} {'added':>7}   medians of {given.runs}")
    for overrides in sets or [{}]:
        with A4Agent.from_profile(given.profile, overrides) as agent:
            rows = measure(agent, pictures, given.photo[1])
        rest, checks = (statistics.median(column) for column in zip(*rows, strict=True))
        added = statistics.median(check / other for other, check in rows)
        name = ", ".join(overrides.get("verifier.signals", ["the profile's own"]))
        print(f"{name:24} {rest:9.3f} s {checks:9.4f} s {added:7.1%}")


if __name__ == "__main__":
    main()
