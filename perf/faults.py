"""What a run survives: fault by fault, how many samples are lost, doubled or wrong once it has been started again.

    python perf/faults.py                 all of them (some three minutes of two quiet cores)
    python perf/faults.py "disk full"     those whose name contains the text

Each try benches drawn pictures with scripted experts in a process of its own, does harm to it, starts it again
without harm until it is complete, and compares its records with those of a run in peace. `lost` are samples without
a record, `doubled` those with two lines in samples.jsonl, `wrong` those whose record differs, and a traceback instead
of a message is counted as such. Full and read-only disks are small file systems in memory, which only root may mount.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import killable
import pictures
from a4agent.experts import registry

SAMPLES = 20
SECONDS = 0.01
"""What each model call takes; a run in peace takes about a second."""
PLUGIN = """
import os, pathlib, signal, sys
sys.path.insert(0, TESTS)
import killable

def create(model, role, *, seconds=0.0):
    expert = killable.create(model, role, seconds=seconds)
    died = pathlib.Path(os.environ["A4FAULTS"]) / model
    answer, calls = expert._answer, []

    def dies_once(*arguments):
        calls.append(1)
        if len(calls) == 5 and not died.exists():
            died.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return answer(*arguments)

    expert._answer = dies_once
    return expert
"""
"""The drawn experts for Ray's actors, each of which kills its process at its fifth call, once."""


@dataclass
class Outcome:
    """The row of one fault."""

    tries: int = 0
    counts: Counter[str] = field(default_factory=Counter[str])
    note: str = ""


class Workplace:
    """A folder with pictures and profile, and the records and the seconds of a run in peace."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._runs = 0
        pictures.write_folder(folder / "data", SAMPLES)
        (folder / "drawn.toml").write_text(killable.PROFILE.replace("SECONDS", str(SECONDS)))
        registry.register("drawn", killable.create)
        self.expected: dict[str, Any] = {}
        started = time.monotonic()
        self.expected = self.records(self.finish(self.new_run()))
        self.seconds = time.monotonic() - started

    def new_run(self, below: Path | None = None) -> Path:
        self._runs += 1
        return (below or self.folder) / f"run-{self._runs}"

    def start(self, run: Path, *more: str, prepare: Callable[[], Any] = lambda: None) -> int:
        """`a4 bench` into `run` in a child process; returns its number. What it prints goes to `run`.log."""
        process = os.fork()
        if process == 0:
            try:
                log = os.open(self.log(run), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
                os.dup2(log, 2)
                prepare()
                data, profile = str(self.folder / "data"), str(self.folder / "drawn.toml")
                command = ["bench", "folder", "--data", data, "--profile", profile, "--out", str(run), *more]
                killable.child(command, None)
            finally:  # a signal may come before `a4` runs; unwound any further, the child would remove our folder
                os._exit(130)
        return process

    def log(self, run: Path) -> Path:
        return self.folder / f"{run.name}.log"

    def finish(self, run: Path, *more: str) -> Path:
        """Start the run again, without harm, until it is complete."""
        wait(self.start(run, *more))
        return run

    def records(self, run: Path) -> dict[str, Any]:
        lines = [json.loads(line) for line in (run / "samples.jsonl").read_text().splitlines()]
        return {row["id"]: without_times(row) for row in lines}

    def check(self, run: Path, outcome: Outcome) -> None:
        """Count what is lost, doubled and wrong in a run that is complete."""
        ids = Counter(json.loads(line)["id"] for line in (run / "samples.jsonl").read_text().splitlines())
        found = self.records(run)
        outcome.counts["lost"] += len(self.expected.keys() - found.keys())
        outcome.counts["doubled"] += sum(count - 1 for count in ids.values())
        outcome.counts["wrong"] += sum(found[name] != self.expected.get(name) for name in found)
        log = self.log(run)
        outcome.counts["tracebacks"] += log.read_text().count("Traceback") if log.exists() else 0


def without_times(row: dict[str, Any]) -> dict[str, Any]:
    steps = [{**step, "seconds": 0, "cached": False, "attempts": 1, "cost": 0} for step in row.pop("trace")]
    return {**row, "trace": steps, "seconds": 0, "cost": 0}


def wait(process: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


def ended(process: int) -> bool:
    return os.waitid(os.P_PID, process, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None


def signals(place: Workplace, tries: int, *numbers: int) -> Outcome:
    """Send signals to runs at random moments; each run is started again until it is complete."""
    outcome, chance = Outcome(), random.Random(sum(numbers))
    while outcome.tries < tries:
        run = place.new_run()
        while True:
            process = place.start(run)
            deadline = time.monotonic() + chance.uniform(0.0, 1.2 * place.seconds)
            while time.monotonic() < deadline and not ended(process):
                time.sleep(0.005)
            if ended(process):
                wait(process)
                break
            for number in numbers:
                os.kill(process, number)
                time.sleep(0.02)
            wait(process)
            outcome.tries += 1
        place.check(run, outcome)
    return outcome


@contextmanager
def small_disk(place: Workplace, kib: int) -> Generator[Path]:
    """A file system in memory of so many KiB."""
    folder = place.folder / "disk"
    folder.mkdir(exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={kib}k", "tmpfs", folder], check=True, capture_output=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", folder], check=True)


def remount(folder: Path, options: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{options}", folder], check=True, capture_output=True)


def disk_full(place: Workplace) -> Outcome:
    """A disk that is one block larger each time, until the whole run fits."""
    outcome = Outcome()
    for kib in range(4, 4096, 4):
        with small_disk(place, kib) as disk:
            run = place.new_run(disk)
            code = wait(place.start(run))
            outcome.tries += 1
            remount(disk, "size=64m")
            place.check(place.finish(run), outcome)
            if code in (0, 1):
                return outcome
    return outcome


def read_only(place: Workplace) -> Outcome:
    """The run's folder, and the cache's, cannot be written."""
    outcome = Outcome()
    with small_disk(place, 65536) as disk:
        for folder in ("run", "cache"):
            run = place.new_run(disk if folder == "run" else None)
            cache = disk / "cache" if folder == "cache" else place.folder / "cache"
            more = ("--cache", "write", "--set", f"engine.cache_dir={cache}")
            (disk / "cache").mkdir(exist_ok=True)
            remount(disk, "ro")
            wait(place.start(run, *more))
            remount(disk, "rw")
            outcome.tries += 1
            place.check(place.finish(run, *more), outcome)
    return outcome


def two_runs(place: Workplace) -> Outcome:
    """Two processes write one folder: one of them has to give way."""
    outcome = Outcome()
    for _ in range(10):
        run = place.new_run()
        codes = [wait(process) for process in [place.start(run), place.start(run)]]
        outcome.tries += 1
        outcome.counts["wrong"] += all(code in (0, 1) for code in codes)
        place.check(place.finish(run), outcome)
    return outcome


def few_handles(place: Workplace) -> Outcome:
    """A limit of open files, from what the interpreter needs to import a module upwards."""
    outcome = Outcome()
    for limit in range(8, 40):
        run = place.new_run()

        def prepare(limit: int = limit) -> None:
            resource.setrlimit(resource.RLIMIT_NOFILE, (limit, limit))

        wait(place.start(run, prepare=prepare))
        outcome.tries += 1
        place.check(place.finish(run), outcome)
    return outcome


def ray_worker(place: Workplace) -> Outcome:
    """Every actor's process is killed at its fifth call; the run goes on without being started again."""
    site, outcome = place.folder / "site", Outcome()
    info = site / "drawn-1.0.dist-info"
    info.mkdir(parents=True)
    (site / "drawn.py").write_text(PLUGIN.replace("TESTS", repr(sys.path[0])))
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: drawn\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[a4agent.experts]\ndrawn = drawn:create\n")
    pools = "".join(f"[ray.{stage}]\nnum_cpus = 0.25\n" for stage in ("dreamer", "thinker", "spotter"))
    profile = place.folder / "ray" / "drawn.toml"  # the name stands in every record
    profile.parent.mkdir()
    profile.write_text(f"{killable.PROFILE.replace('SECONDS', str(SECONDS))}{pools}")
    for _ in range(3):
        run = place.new_run()
        deaths = place.folder / f"deaths-{run.name}"
        deaths.mkdir()
        main = "import sys; from a4agent.cli.main import main; main(sys.argv[1:])"
        command = ["bench", "folder", "--data", place.folder / "data", "--profile", profile, "--out", run]
        environment = {**os.environ, "PYTHONPATH": str(site), "A4FAULTS": str(deaths)}
        with place.log(run).open("w") as log:
            subprocess.run(
                [sys.executable, "-c", main, *map(str, command), "--engine", "ray"],
                env=environment,
                stdout=subprocess.DEVNULL,
                stderr=log,
                check=False,
            )
        outcome.tries += len(list(deaths.iterdir()))
        place.check(run, outcome)
    return outcome


FAULTS: dict[str, Callable[[Workplace], Outcome]] = {
    "SIGKILL": lambda place: signals(place, 100, signal.SIGKILL),
    "SIGTERM": lambda place: signals(place, 20, signal.SIGTERM),
    "SIGHUP": lambda place: signals(place, 20, signal.SIGHUP),
    "SIGINT (Ctrl-C) once": lambda place: signals(place, 20, signal.SIGINT),
    "SIGINT (Ctrl-C) twice": lambda place: signals(place, 20, signal.SIGINT, signal.SIGINT),
    "disk full at every block": disk_full,
    "read-only folder": read_only,
    "two runs on one folder": two_runs,
    "file handles exhausted": few_handles,
    "Ray worker killed": ray_worker,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", nargs="?", default="", help="only faults whose name contains this")
    wanted = parser.parse_args().name.lower()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # as a shell leaves them for a job in front
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    columns = ("lost", "doubled", "wrong", "tracebacks")
    print("| fault | tries | lost | doubled | wrong | tracebacks |\n|---|---|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        place = Workplace(Path(folder))
        for name, harm in FAULTS.items():
            if wanted not in name.lower():
                continue
            try:
                outcome = harm(place)
            except (subprocess.CalledProcessError, PermissionError) as error:
                print(f"| {name} | not run: {error} | | | | |", flush=True)
                continue
            row = " | ".join(str(outcome.counts[column]) for column in columns)
            print(f"| {name} | {outcome.tries} | {row} |", flush=True)


if __name__ == "__main__":
    main()
