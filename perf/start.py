"""How long a person waits: import, help, one offline prediction in process and as a cold command.

    python perf/start.py [--runs 7] [--json]

Each figure is the median of several runs, in seconds, beside an empty `python -c pass` of the same run,
so that a slow machine is seen for what it is.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

PHOTO = Path(__file__).parent.parent / "examples" / "coffee.jpg"
GOALS = {"import a4agent": 0.15, "a4 --help": 0.4, "predict, in process": 1.0, "a4 predict, cold": 2.5}


def median(runs: int, action: Callable[[], object]) -> float:
    """Seconds, after one run that does not count."""
    action()
    taken: list[float] = []
    for _ in range(runs):
        started = time.perf_counter()
        action()
        taken.append(time.perf_counter() - started)
    return statistics.median(taken)


def command(*arguments: str) -> Callable[[], object]:
    return lambda: subprocess.run([sys.executable, *arguments], check=True, capture_output=True)


def measure(runs: int) -> dict[str, float]:
    """All figures, in seconds."""
    from PIL import Image

    from a4agent import A4Agent

    figures = {"python -c pass": median(runs, command("-c", "pass"))}
    figures["import a4agent"] = median(runs, command("-c", "import a4agent")) - figures["python -c pass"]
    figures["a4 --help"] = median(runs, command("-m", "a4agent.cli.main", "--help"))
    photo = Image.open(PHOTO).convert("RGB").resize((640, 480))
    pictures = [photo.rotate(angle, resample=Image.Resampling.BILINEAR) for angle in range(runs + 1)]
    with A4Agent.from_profile("offline") as agent:
        # Another picture each time: nothing kept from the last one may help.
        figures["predict, in process"] = median(runs, lambda: agent.predict(pictures.pop(), "fill the cup"))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "photo.png")
        photo.save(path)
        arguments = ["predict", str(path), "fill the cup", "--profile", "offline", "--out", folder]
        figures["a4 predict, cold"] = median(runs, command("-m", "a4agent.cli.main", *arguments))
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    figures = measure(options.runs)
    if options.json:
        print(json.dumps(figures))
        return
    for name, seconds in figures.items():
        goal = f"goal {GOALS[name]:.2f} s, {seconds / GOALS[name]:.0%} of it" if name in GOALS else ""
        print(f"{name:22} {seconds:7.3f} s   {goal}")


if __name__ == "__main__":
    main()
