"""Every task is declared whole and starts undone."""

from __future__ import annotations

import numpy as np
import pytest

from a4agent.sim.act import BY_NAME
from a4agent.sim.act_tasks import TASKS, ActTask
from a4agent.sim.act_trial import Trial


def test_there_are_at_least_twelve_tasks_with_distinct_names() -> None:
    assert len(BY_NAME) == len(TASKS) >= 12
    assert all(task.sentences and task.part and task.waypoints for task in TASKS)


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.name)
def test_no_task_is_done_before_the_hand_moves(task: ActTask, simulator: None) -> None:
    with Trial(task, 0) as trial:
        assert not trial.done
        assert (trial.at >= np.array(task.low)).all()
        assert (trial.at <= np.array(task.high)).all()
