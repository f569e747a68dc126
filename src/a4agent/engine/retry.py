"""When to ask again: how long a failed request waits, how many calls go at once, and when calls are held back."""

from __future__ import annotations

import copy
import random
import threading
import time

from a4agent.errors import A4Error, ProviderError

LONGEST_WAIT = 30.0
FAILURES_TO_OPEN = 10


def backoff(failures: int, first: float, error: Exception, max_retry_after: float) -> float:
    """Seconds before a request that failed `failures` times is sent again.

    `first` seconds, doubled with each failure up to 30, shortened at random by up to half so that requests
    that failed together are not sent together; at least what the provider asked for, up to `max_retry_after`.
    """
    wait = min(first * 2 ** (failures - 1), LONGEST_WAIT) * random.uniform(0.5, 1.0)
    return max(wait, min(getattr(error, "retry_after", None) or 0.0, max_retry_after))


def fresh(error: A4Error) -> A4Error:
    """A copy of an error to raise in another thread, with its own traceback and number of attempts."""
    try:
        twin = copy.copy(error)
    except TypeError:  # the `__init__` of another package's error may need more than the message
        return error
    twin.__cause__ = error.__cause__
    return twin


class Pace:
    """How many calls at once a provider takes: fewer after a rate limit, more while calls succeed.

    It drops by three tenths for each round of calls that met the limit, returns quickly to just below where
    that was, and rises from there by one in five rounds.
    """

    def __init__(self, most: int) -> None:
        self._most = float(most)
        self._now = float(most)
        self._limit = float(most)
        self._dropped_at = 0.0

    @property
    def calls(self) -> int:
        return int(self._now)

    def succeeded(self) -> None:
        step = 1.0 if self._now < self._limit else 0.2
        self._now = min(self._most, self._now + step / self._now)

    def limited(self, started: float) -> None:
        """A call that was made at `started` (monotonic) met the limit."""
        if started >= self._dropped_at:
            self._limit = 0.9 * self._now
            self._now = max(1.0, 0.7 * self._now)
            self._dropped_at = time.monotonic()


class Breaker:
    """Holds calls back while an expert is down.

    After ten failures in a row it holds all calls back for `pause` seconds, lets one through to see, and
    doubles the pause until one succeeds. An expert that is down for `outage_seconds` is given up: `enter`
    then raises the reason, which is fatal to the run.
    """

    def __init__(self, expert: str, pause: float = 1.0, outage_seconds: float = 300.0) -> None:
        self._expert = expert
        self._first_pause = pause
        self._outage_seconds = outage_seconds
        self._changed = threading.Condition()
        self._failures = 0
        self._pause = pause
        self._until = 0.0
        self._down_since = 0.0
        self._probing = False
        self._given_up: A4Error | None = None
        self._no_waiting: A4Error | None = None

    @property
    def is_open(self) -> bool:
        """Whether the expert counts as down; failures then are the expert's, not the request's."""
        return self._failures >= FAILURES_TO_OPEN

    def enter(self) -> None:
        """Wait until a call may be made.

        Raises:
            A4Error: the expert was given up, or waits were ended.
        """
        with self._changed:
            while True:
                if self._given_up:
                    raise fresh(self._given_up)
                pause = self._until - time.monotonic()
                if pause <= 0 and not (self.is_open and self._probing):
                    self._probing = self.is_open
                    return
                if self._no_waiting:
                    raise fresh(self._no_waiting)
                self._changed.wait(pause if pause > 0 else None)

    def succeeded(self) -> None:
        """The expert answered, whatever the answer."""
        with self._changed:
            self._failures, self._pause, self._probing = 0, self._first_pause, False
            self._changed.notify_all()

    def failed(self, error: ProviderError) -> None:
        """The expert could not be asked."""
        with self._changed:
            now = time.monotonic()
            self._failures += 1
            if self._failures == FAILURES_TO_OPEN:
                self._down_since, self._until = now, now + self._pause
            elif self.is_open and self._probing:
                self._pause = min(self._pause * 2, LONGEST_WAIT)
                self._until, self._probing = now + self._pause, False
                if now - self._down_since >= self._outage_seconds:
                    self.give_up(self._explained(error, now))
            self._changed.notify_all()

    def give_up(self, error: A4Error) -> None:
        """Make no more calls; each attempt raises `error`."""
        with self._changed:
            self._given_up = self._given_up or error
            self._changed.notify_all()

    def end_waits(self, error: A4Error) -> None:
        """Raise `error` for the calls that wait, and for those that would have to."""
        with self._changed:
            self._no_waiting = error
            self._changed.notify_all()

    def _explained(self, error: ProviderError, now: float) -> A4Error:
        reason = ProviderError(
            f"{self._expert} has failed {self._failures} times in a row for {now - self._down_since:.0f} s, so the run"
            f" stops here; the last error: {error}. Run the same command again when it is back (finished samples are"
            " kept), or allow longer outages with engine.outage_seconds"
        )
        reason.fatal = True
        return reason
