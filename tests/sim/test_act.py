"""A small slice of sim-act: the true part succeeds, a point elsewhere does not, and a trial repeats exactly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import pictures
from a4agent.config import Settings
from a4agent.errors import A4Error, ConfigError, DataError
from a4agent.runs.bench import Bench
from a4agent.runs.compare import compare
from a4agent.runs.report import render
from a4agent.runs.store import read_run
from a4agent.sim.act import create, make_trials
from a4agent.sim.act_tasks import TASKS
from a4agent.types import Affordance, Region

BY_NAME = {task.name: task for task in TASKS}
FEW = (BY_NAME["drawer-open"], BY_NAME["button-press"])


@pytest.fixture(scope="module")
def trials(simulator: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_trials(tmp_path_factory.mktemp("act") / "set", seeds=1, tasks=FEW)


def answer(mask: np.ndarray, status: str = "ok") -> Affordance:
    height, width = mask.shape
    regions = (Region(None, np.zeros((0, 2), np.float32), mask),) if mask.any() else ()
    return Affordance("open", (width, height), regions=regions, status=status)  # pyright: ignore[reportArgumentType]


def test_the_true_part_succeeds_and_another_place_is_lost(trials: Path) -> None:
    benchmark = create(trials)
    assert len(benchmark) == 2
    assert benchmark.measure is not None
    for sample in benchmark:
        truth = sample.truth.mask()
        found = benchmark.measure(sample, answer(truth))
        assert found["success"] == found["success (ok)"] == found["coverage"] == 1
        assert found["contact cm"] == pytest.approx(0, abs=0.5)
        assert found["lost: part"] == found["lost: depth"] == found["lost: control"] == 0
        assert benchmark.frames is not None
        frames = benchmark.frames(sample)
        assert 4 <= len(frames) <= 20
        assert {frame.size for frame in frames} == {(192, 144)}
        first, last = (np.asarray(frame, np.float64) for frame in (frames[0], frames[-1]))
        assert first.std() > 5
        assert np.abs(first - last).mean() > 1, "the hand has moved"
        assert not benchmark.frames(sample), "frames are handed over once"
        corner = np.zeros_like(truth)
        corner[-60:, :60] = True
        missed = benchmark.measure(sample, answer(corner, "abstained"))
        assert missed["success"] == 0
        assert np.isnan(missed["success (ok)"])
        assert missed["coverage"] == 0
        assert missed["lost: part"] == 1
        assert missed["contact cm"] > 5


def test_a_run_goes_on_after_a_kill_and_its_report_shows_the_trials(trials: Path, tmp_path: Path) -> None:
    scripted = {
        "thinker": {"vlm": "scripted:vlm"},
        "spotter": {"detector": "scripted:detector", "segmenter": "scripted:segmenter"},
    }
    settings = Settings.model_validate({"name": "scripted", **scripted})
    work = Bench(create(trials), settings, oracle="segmenter", out=tmp_path / "run")
    agent = pictures.agent()
    with work.open(agent) as session:
        next(iter(session))
    first = read_run(tmp_path / "run")
    assert len(first.records) == 1
    run = work.run(agent)
    assert len(run.records) == 2
    for record in run.records.values():
        assert record.measures["success"] == 1
        assert {"frames", "animation"} <= set(record.pictures)
        assert all((run.folder / name).is_file() for name in record.pictures.values())
    page = render(run)
    assert page.count('"animation": "') == 2
    assert '"success": 1' in page
    assert any(line.name == "success" and line.second == 1 for line in compare(run, run).lines())


def test_an_empty_answer_fails_without_a_contact(trials: Path) -> None:
    benchmark = create(trials)
    assert benchmark.measure is not None
    sample = benchmark[0]
    found = benchmark.measure(sample, answer(np.zeros_like(sample.truth.mask()), "empty"))
    assert found["success"] == 0
    assert np.isnan(found["contact cm"])
    assert found["lost: part"] == 1


def test_the_same_answer_acts_the_same_twice(trials: Path) -> None:
    benchmark = create(trials, contact="random")
    assert benchmark.measure is not None
    sample = benchmark[1]
    blank = answer(np.zeros_like(sample.truth.mask()), "empty")
    first, second = benchmark.measure(sample, blank), benchmark.measure(sample, blank)
    assert str(first) == str(second)


def test_any_point_of_the_true_part_lies_on_it(trials: Path) -> None:
    benchmark = create(trials, contact="part", frames=False)
    assert benchmark.measure is not None
    assert benchmark.frames is not None
    for sample in benchmark:
        found = benchmark.measure(sample, answer(np.zeros_like(sample.truth.mask()), "empty"))
        assert found["contact cm"] == pytest.approx(0, abs=1e-6)
        assert found["lost: part"] == 0
        assert not benchmark.frames(sample), "nothing was filmed"


def test_the_source_of_the_contact_is_part_of_the_fingerprint(trials: Path) -> None:
    assert create(trials).fingerprint() != create(trials, contact="object").fingerprint()


def test_wrong_options_and_rows_are_refused(trials: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="answer, object, part, random"):
        create(trials, contact="nothing")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ConfigError, match="seeds"):
        create(trials, seeds=0)
    (tmp_path / "samples.jsonl").write_text('{"id": "a"}\n', encoding="utf-8")
    with pytest.raises(DataError, match="line 1"):
        create(tmp_path)
    with pytest.raises(A4Error):
        create(tmp_path / "absent")
