"""A server of processes to be killed: imports once, then forks a fresh `a4` for every line of JSON on stdin.

    {"arguments": ["bench", "folder", ...], "kill_after": 0.12, "signal": 9}   ->   {"status": -9, "seconds": 0.12}

The signal is sent after so many seconds, or once the file of `kill_at: [FILE, N]` has N lines, or before the Nth
time that a path of the folder of `kill_before: [FOLDER, N]` is opened, made, renamed or removed, or not at all.
The experts of `pictures.py` are there as the provider `drawn`.
"""

from __future__ import annotations

import itertools
import json
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import scipy.optimize  # noqa: F401

import a4agent.cli.bench
import a4agent.runs.bench
import a4agent.runs.scores
import a4agent.runs.tables  # noqa: F401
import pictures
from a4agent.cli.main import main
from a4agent.experts import registry

NAMES = {"vlm": "VLM", "editor": "Editor", "detector": "Detector", "segmenter": "Segmenter"}
PROFILE = """
[dreamer]
vlm = {expert = "drawn:vlm", seconds = SECONDS}
editor = {expert = "drawn:editor", seconds = SECONDS}
[thinker]
vlm = {expert = "drawn:vlm", seconds = SECONDS}
reasks = 0
[spotter]
detector = {expert = "drawn:detector", seconds = SECONDS}
segmenter = {expert = "drawn:segmenter", seconds = SECONDS}
"""


def create(model: str, role: str, *, seconds: float = 0.0) -> Any:
    experts = pictures.agent(seconds).experts()
    return next(expert for expert in experts if type(expert).__name__ == f"Scripted{NAMES[role]}")


def die_before(folder: str, step: int) -> None:
    """Be killed before the file system is asked for the `step`th thing inside `folder`."""
    steps = itertools.count(1)

    def audit(event: str, arguments: tuple[Any, ...]) -> None:
        if event != "open" and not event.startswith("os."):
            return
        paths = [os.fsdecode(item) for item in arguments if isinstance(item, str | bytes | os.PathLike)]
        if any(path.startswith(folder) for path in paths) and next(steps) == step:
            os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(audit)


def child(arguments: list[str], kill_before: tuple[str, int] | None) -> None:
    """Be `a4`, with what it prints thrown away."""
    if kill_before:
        die_before(*kill_before)
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    code: Any = 0
    try:
        main(arguments)
    except SystemExit as error:
        code = error.code
    os._exit(code or 0)


def wait_for_lines(path: Path, count: int) -> None:
    while not path.exists() or path.read_bytes().count(b"\n") < count:
        time.sleep(0.002)


def serve() -> None:
    registry.register("drawn", create)
    for line in sys.stdin:
        order = json.loads(line)
        started = time.monotonic()
        process = os.fork()
        if process == 0:
            child(order["arguments"], order["kill_before"])
        if order["kill_after"] is not None:
            time.sleep(order["kill_after"])
            os.kill(process, order["signal"])
        elif order["kill_at"] is not None:
            wait_for_lines(Path(order["kill_at"][0]), order["kill_at"][1])
            os.kill(process, order["signal"])
        status = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
        print(json.dumps({"status": status, "seconds": time.monotonic() - started}), flush=True)


if __name__ == "__main__":
    serve()
