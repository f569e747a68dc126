"""When a run begins no more samples: a signal, an error that all samples would meet, or a used-up budget."""

from __future__ import annotations

import signal
import threading
import time
from types import FrameType
from typing import Any

from a4agent.errors import BudgetExceeded
from a4agent.types import Trace

SIGNALS = {
    getattr(signal, name): handler
    for name, handler in (
        ("SIGINT", signal.default_int_handler),
        ("SIGTERM", signal.SIG_DFL),
        ("SIGHUP", signal.SIG_DFL),
    )
    if hasattr(signal, name)
}
"""The signals that stop a run, each with the handler that we replace: a program's own handler stays."""
UNTIL_PRICED = 4
"""Samples that may run at once while none has finished and shown what one costs."""


class Stop:
    """Holds the first `reason` to begin no more samples; None while there is none.

    Within its `with` block, in the main thread, the first Ctrl-C, SIGTERM or SIGHUP is such a reason, and the second
    raises KeyboardInterrupt.
    """

    def __init__(self) -> None:
        self.reason: BaseException | None = None
        self.interrupted = False
        self._over = False
        self._replaced: dict[int, Any] = {}

    def request_stop(self, reason: BaseException) -> None:
        """Begin no more samples; the first reason counts."""
        self.reason = self.reason or reason

    def __enter__(self) -> Stop:
        if threading.current_thread() is threading.main_thread():
            for number, expected in SIGNALS.items():
                if signal.getsignal(number) is expected:
                    signal.signal(number, self._interrupt)
                    self._replaced[number] = expected
        return self

    def __exit__(self, *_: Any) -> None:
        self._over = True  # a generator may be closed in another thread, which cannot restore the handlers
        if threading.current_thread() is threading.main_thread():
            for number, handler in self._replaced.items():
                signal.signal(number, handler)

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if self.interrupted or self._over:
            raise KeyboardInterrupt
        self.interrupted = True
        self.request_stop(KeyboardInterrupt())


class Budget:
    """US dollars and seconds that a run may take; None means no limit.

    Each sample in flight is expected to cost as much as the most expensive one so far, and the next one to take as
    long as the latest ones did. So a run stays within its budget unless a sample costs more than all before it.
    """

    def __init__(self, max_cost: float | None = None, max_seconds: float | None = None) -> None:
        self._max_cost = max_cost
        self._max_seconds = max_seconds
        self._started = time.monotonic()
        self._changed = threading.Condition()
        self._running = 0
        self._finished = 0
        self._spent = 0.0
        self._highest_cost: float | None = None
        self._seconds_each = 0.0

    def start(self) -> None:
        """Count a sample in; wait while only the samples in flight can show whether it fits.

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
                        f" {self._highest_cost or 0.0:.4f}; raise it and run again to continue"
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
            each = max(self._highest_cost or 0.0, 2 * trace.cost)
            if self._spent + self._running * each > self._max_cost:
                return False
            if trace.cost:
                self._highest_cost = each
            return True

    def finish(self, trace: Trace | None, seconds: float) -> None:
        """Count a sample out, with what it took; without a trace it did not run."""
        with self._changed:
            self._running -= 1
            if trace is not None:
                self._finished += 1
                self._spent += trace.cost
                if any(not step.cached for step in trace.steps):
                    self._highest_cost = max(self._highest_cost or 0.0, trace.cost)
                self._seconds_each += (seconds - self._seconds_each) * max(0.1, 1 / self._finished)
            self._changed.notify_all()

    def _affordable(self) -> bool:
        if self._max_cost is None:
            return True
        if self._highest_cost is None:
            return self._running < UNTIL_PRICED and self._spent < self._max_cost
        return self._spent + (self._running + 1) * self._highest_cost <= self._max_cost

    def _check_time(self) -> None:
        if self._max_seconds is None:
            return
        elapsed = time.monotonic() - self._started
        if elapsed + self._seconds_each > self._max_seconds:
            raise BudgetExceeded(
                f"the budget of engine.max_seconds = {self._max_seconds:g} is used up: {self._finished} samples"
                f" finished in {elapsed:.1f} s, and another takes {self._seconds_each:.1f} s; run again to continue"
            )
