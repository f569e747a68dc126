"""Stopping in time: a sample is started only if it is expected to end within the budget of money and time."""

from __future__ import annotations

import threading
import time

from a4agent.errors import BudgetExceeded
from a4agent.types import Trace

UNTIL_PRICED = 4
"""Samples that may run at once while none has ended and shown what one costs."""


class Budget:
    """US dollars and seconds a run may take; None is no limit.

    Every sample in flight is expected to cost what the dearest one did, and a new one to take as long as the
    latest ones did. So the samples in flight can always finish, and a run ends within its budget unless
    a sample costs more than all before it.
    """

    def __init__(self, max_cost: float | None = None, max_seconds: float | None = None) -> None:
        self._max_cost = max_cost
        self._max_seconds = max_seconds
        self._started = time.monotonic()
        self._changed = threading.Condition()
        self._running = 0
        self._finished = 0
        self._spent = 0.0
        self._dearest: float | None = None
        self._seconds_each = 0.0

    def start(self) -> None:
        """Count a sample in, waiting for others to end if only they can tell whether it fits.

        Raises:
            BudgetExceeded: there is no room for another sample.
        """
        with self._changed:
            self._check_time()
            while not self._affordable():
                if not self._running:
                    raise BudgetExceeded(
                        f"the budget of engine.max_cost = {self._max_cost:g} dollars is used up:"
                        f" {self._spent:.4f} spent on {self._finished} samples, and the next may cost"
                        f" {self._dearest or 0.0:.4f}; raise it and run again to go on"
                    )
                self._changed.wait()
                self._check_time()
            self._running += 1

    def may_retry(self, trace: Trace) -> bool:
        """Whether a running sample may ask a stage again, given its steps so far.

        That is expected to cost and take no more than the sample has so far. From then on, every sample in flight is
        expected to cost as much, so that they all can finish.
        """
        with self._changed:
            if self._max_seconds is not None:
                elapsed = time.monotonic() - self._started
                if elapsed + trace.seconds > self._max_seconds:
                    return False
            if self._max_cost is None:
                return True
            each = max(self._dearest or 0.0, 2 * trace.cost)
            if self._spent + self._running * each > self._max_cost:
                return False
            if trace.cost:
                self._dearest = each
            return True

    def finish(self, trace: Trace | None, seconds: float) -> None:
        """Count a sample out, with what it took; without a trace it did not run."""
        with self._changed:
            self._running -= 1
            if trace is not None:
                self._finished += 1
                self._spent += trace.cost
                if any(not step.cached for step in trace.steps):
                    self._dearest = max(self._dearest or 0.0, trace.cost)
                self._seconds_each += (seconds - self._seconds_each) * max(0.1, 1 / self._finished)
            self._changed.notify_all()

    def _affordable(self) -> bool:
        if self._max_cost is None:
            return True
        if self._dearest is None:
            return self._running < UNTIL_PRICED and self._spent < self._max_cost
        expected = self._spent + (self._running + 1) * self._dearest
        return expected <= self._max_cost

    def _check_time(self) -> None:
        if self._max_seconds is None:
            return
        elapsed = time.monotonic() - self._started
        if elapsed + self._seconds_each > self._max_seconds:
            raise BudgetExceeded(
                f"the budget of engine.max_seconds = {self._max_seconds:g} is used up:"
                f" {self._finished} samples ended in {elapsed:.1f} s, and another takes"
                f" {self._seconds_each:.1f} s; run again to go on"
            )
