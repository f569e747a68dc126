from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from concurrent.futures import wait

import pytest

from a4agent.serve.workers import Cancelled, Counters, Job, Workers
from a4agent.testing import ScriptedVLM, scripted_agent


def nobody(name: str, value: object) -> None:
    return None


@pytest.fixture
def workers() -> Iterator[Workers]:
    workers = Workers([scripted_agent()], Counters())
    workers.start()
    yield workers
    workers.close()


def test_jobs_are_taken_in_the_order_they_came(workers: Workers) -> None:
    begin, order = threading.Event(), []
    first = workers.submit(lambda agent, tell: begin.wait(5), nobody)
    jobs = [workers.submit(lambda agent, tell, i=i: order.append(i), nobody) for i in range(20)]
    assert [workers.position(job) for job in jobs[:3]] in ([0, 1, 2], [1, 2, 3])
    begin.set()
    wait([first.future, *(job.future for job in jobs)], timeout=5)
    assert order == list(range(20))
    assert workers.position(jobs[0]) == 0


def test_a_cancelled_job_is_not_begun_and_holds_no_place(workers: Workers) -> None:
    begin = threading.Event()
    workers.submit(lambda agent, tell: begin.wait(5), nobody)
    dropped = workers.submit(lambda agent, tell: pytest.fail("it was begun"), nobody)
    behind = workers.submit(lambda agent, tell: "done", nobody)
    time.sleep(0.05)
    dropped.cancel()
    assert workers.position(behind) == 0
    begin.set()
    assert behind.future.result(5) == "done"
    assert isinstance(dropped.future.exception(5), Cancelled)


def test_a_running_job_stops_at_the_next_thing_it_tells(workers: Workers) -> None:
    told: list[str] = []
    running: list[Job] = []

    def work(agent: object, tell: object) -> None:
        tell("first", None)  # type: ignore[operator]
        running[0].cancel()
        tell("second", None)  # type: ignore[operator]
        told.append("never")

    submitted = threading.Event()

    def patient(agent: object, tell: object) -> None:
        submitted.wait(5)
        work(agent, tell)

    running.append(workers.submit(patient, lambda name, value: told.append(name)))
    submitted.set()
    assert isinstance(running[0].future.exception(5), Cancelled)
    assert told == ["first"]


def test_a_worker_outlives_whatever_its_job_raises(workers: Workers) -> None:
    failed = workers.submit(lambda agent, tell: 1 / 0, nobody)
    assert isinstance(failed.future.exception(5), ZeroDivisionError)
    assert workers.submit(lambda agent, tell: 7, nobody).future.result(5) == 7
    assert workers.alive()


def test_closing_finishes_what_was_submitted_and_closes_each_agent_once() -> None:
    closed: list[int] = []

    class Counting(ScriptedVLM):
        def close(self) -> None:
            closed.append(1)

    agent = scripted_agent().with_experts(lambda expert: Counting([]) if isinstance(expert, ScriptedVLM) else expert)
    workers = Workers([agent, agent], Counters())
    assert not workers.alive()
    workers.start()
    jobs = [workers.submit(lambda agent, tell: time.sleep(0.01), nobody) for _ in range(10)]
    workers.close()
    assert all(job.future.done() for job in jobs)
    assert closed == [1]
    assert not workers.alive()


def test_the_wait_is_told_from_what_jobs_took(workers: Workers) -> None:
    for _ in range(12):
        workers.submit(lambda agent, tell: time.sleep(0.05), nobody).future.result(5)
    assert 0.04 < workers.seconds_to_wait() < 0.2
