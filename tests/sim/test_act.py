"""A small slice of sim-act: the true part succeeds, a point elsewhere does not, and a trial repeats exactly."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pictures
from a4agent.acting.contact import contact_points
from a4agent.config import Settings
from a4agent.errors import A4Error, ConfigError, DataError
from a4agent.runs.bench import Bench
from a4agent.runs.compare import compare
from a4agent.runs.report import render
from a4agent.runs.store import read_run
from a4agent.sim.act import create, make_trials
from a4agent.sim.act_tasks import TASKS, ActTask
from a4agent.sim.act_trial import Trial
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


def test_there_are_at_least_twelve_tasks_with_distinct_names() -> None:
    assert len(BY_NAME) == len(TASKS) >= 12
    assert all(task.sentences and task.part and task.waypoints for task in TASKS)


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.name)
def test_no_task_is_done_before_the_hand_moves(task: ActTask, simulator: None) -> None:
    with Trial(task, 0) as trial:
        assert not trial.done
        assert (trial.at >= np.array(task.low)).all()
        assert (trial.at <= np.array(task.high)).all()


@pytest.mark.parametrize("name", ["hammer-lift", "handle-pull", "plug-pull"])
def test_open_fingers_take_hold_and_closed_ones_do_not(name: str, simulator: None) -> None:
    task = BY_NAME[name]
    with Trial(task, 0) as trial:
        view = trial.photograph()
        contact = contact_points(view.part, view.depth.astype(np.float64), view.camera)[0]
        assert contact.position_xyz is not None
        place = view.to_world(contact.position_xyz)
        assert trial.act(place).success
    with Trial(replace(task, grasp=None), 0) as trial:
        assert not trial.act(place).success


def test_the_microwave_of_another_package_opens(simulator: None) -> None:
    task = BY_NAME["microwave-open"]
    with Trial(task, 0) as trial:
        view = trial.photograph()
        contact = contact_points(view.part, view.depth.astype(np.float64), view.camera)[0]
        assert contact.position_xyz is not None
        assert trial.act(view.to_world(contact.position_xyz)).success
        assert view.image[:40].mean() > 60, "the sky of the scene is still there"
        assert float(trial.data.qpos[9]) < -0.45


def test_the_hand_does_not_move_for_a_point_out_of_reach(simulator: None) -> None:
    with Trial(BY_NAME["button-press"], 0) as trial:
        before = trial.data.qpos.copy()
        filmed: list[int] = []
        outcome = trial.act(np.array([-30.0, 50.0, -10.0]), lambda: filmed.append(1))
        assert (outcome.success, outcome.steps, len(filmed)) == (False, 0, 1)
        assert (trial.data.qpos == before).all()


def test_a_guest_that_is_not_in_its_file_is_named(simulator: None) -> None:
    task = BY_NAME["microwave-open"]
    assert task.guest is not None
    with pytest.raises(DataError, match=r"microwave-open.* needs a body .* and 'no-oven'"):
        Trial(replace(task, guest=replace(task.guest, root="no-oven")), 0)


def test_the_picture_and_the_world_agree(simulator: None) -> None:
    with Trial(BY_NAME["button-press"], 1) as trial:
        view = trial.photograph()
        contact = contact_points(view.part, view.depth.astype(np.float64), view.camera)[0]
        assert contact.position_xyz is not None
        centre = np.asarray(trial.data.geom("btnGeom").xpos)
        assert np.linalg.norm(view.to_world(contact.position_xyz) - centre) < 0.04
    assert view.part[~view.thing].sum() == 0
    assert view.image.shape == (480, 640, 3)


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
