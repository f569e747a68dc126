"""A run is killed at random instants and started again, as often as it takes: nothing is lost, nothing is doubled."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import killable
import pictures
from a4agent.files import is_draft
from a4agent.runs import scores
from a4agent.runs.store import Run, read_run

KILLS = 20
SAMPLES = 30

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")

Start = Callable[..., dict[str, Any]]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Runs `a4 bench` on drawn pictures in a process of its own, killed after a while or not."""
    data = pictures.write_folder(tmp_path / "data", SAMPLES)
    for seconds in ("0.004", "0.03"):
        (tmp_path / f"{seconds}.toml").write_text(killable.PROFILE.replace("SECONDS", seconds))
    search = os.pathsep.join([str(Path(killable.__file__).parent), os.environ.get("PYTHONPATH", "")])
    server = subprocess.Popen(
        [sys.executable, killable.__file__],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": search, "OMP_NUM_THREADS": "1"},
    )

    def order(
        out: Path,
        *,
        kill_after: float | None = None,
        kill_at: tuple[str, int] | None = None,
        kill_before: tuple[str, int] | None = None,
        limit: int = SAMPLES,
        how: int = signal.SIGKILL,
        seconds: str = "0.004",
    ) -> dict[str, Any]:
        options = ["--data", data, "--profile", tmp_path / f"{seconds}.toml", "--out", out, "--limit", limit]
        line = {
            "arguments": ["bench", "folder", *map(str, options)],
            "kill_after": kill_after,
            "kill_at": kill_at,
            "kill_before": kill_before,
            "signal": how,
        }
        assert server.stdin is not None
        assert server.stdout is not None
        server.stdin.write(json.dumps(line) + "\n")
        server.stdin.flush()
        return json.loads(server.stdout.readline())

    with server:
        yield order
        assert server.stdin is not None
        server.stdin.close()


def rows(run: Run) -> dict[str, Any]:
    """All that a run says of its samples, but how long the calls took."""
    return {
        id: {**record.row, "trace": [{**step, "seconds": 0} for step in record.row["trace"]]}
        for id, record in run.records.items()
    }


def test_killed_at_twenty_random_instants_it_ends_as_if_nothing_had_been(start: Start, tmp_path: Path) -> None:
    whole = start(tmp_path / "undisturbed")
    undisturbed = read_run(tmp_path / "undisturbed")
    assert whole["status"] == 1, "some samples are meant to fail"
    assert len(undisturbed.records) == SAMPLES

    warm = start(tmp_path / "undisturbed again")  # the first one may have waited for a busy machine
    seconds = min(whole["seconds"], warm["seconds"])
    instants = random.Random(20)
    kills, rounds = 0, 0
    reached: Counter[int] = Counter()
    while kills < KILLS:
        rounds += 1
        folder = tmp_path / f"killed {rounds}"
        complete = False
        while not complete:
            delay = instants.uniform(0.0, seconds) if kills < KILLS else None
            status = start(folder, kill_after=delay)["status"]
            assert status in (1, -signal.SIGKILL), "a kill is no reason to refuse the folder"
            kills += status == -signal.SIGKILL
            complete = status == 1
            if not complete and (folder / "manifest.json").exists():
                reached[len(read_run(folder).records)] += 1
        killed = read_run(folder)
        assert rows(killed) == rows(undisturbed)
        assert scores.score(killed) == scores.score(undisturbed)
        lines = [json.loads(line)["id"] for line in (folder / "samples.jsonl").read_bytes().splitlines()]
        assert Counter(lines) == Counter(undisturbed.records.keys()), "each sample was asked for and written once"
    assert len(reached) > 3, f"the kills came at different points: {reached}"


def test_killed_before_any_touch_of_the_disk_it_goes_on(start: Start, tmp_path: Path) -> None:
    start(tmp_path / "undisturbed", limit=2)
    undisturbed = rows(read_run(tmp_path / "undisturbed"))
    step, killed = 0, True
    while killed:
        step += 1
        folder = tmp_path / f"killed before step {step}"
        killed = start(folder, limit=2, kill_before=(str(folder), step))["status"] == -signal.SIGKILL
        assert start(folder, limit=2)["status"] == 1, f"step {step}"
        assert rows(read_run(folder)) == undisturbed
        drafts = [path.name for path in folder.rglob("*") if is_draft(path)]
        assert not drafts, "what was half written is swept away"
    assert step > 15, "manifest, lock, samples, pictures and scores are all on the way"


def test_ctrl_c_keeps_what_is_in_flight_and_says_so_by_its_exit_code(start: Start, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    ended = start(folder, kill_at=(str(folder / "samples.jsonl"), 3), how=signal.SIGINT, seconds="0.03")
    assert ended["status"] == 130
    part = len(read_run(folder).records)
    assert 3 <= part < SAMPLES
    assert (folder / "scores.json").exists()
    assert start(folder, seconds="0.03")["status"] == 1
    assert len(read_run(folder).records) == SAMPLES
