"""When a run starts no more samples: a reason that is given once, and Ctrl-C."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any


class Stop:
    """Holds the first `reason` to start no more samples; None while there is none.

    Within its `with` block the first Ctrl-C is such a reason and the second raises KeyboardInterrupt, where Python's
    own handler is in place: in the main thread of a program that has no other.
    """

    def __init__(self) -> None:
        self.reason: BaseException | None = None
        self.interrupted = False
        self._over = False
        self._installed = False

    def because(self, reason: BaseException) -> None:
        """Start no more samples; the first reason counts."""
        self.reason = self.reason or reason

    def __enter__(self) -> Stop:
        ours = threading.current_thread() is threading.main_thread()
        if ours and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, self._interrupt)
            self._installed = True
        return self

    def __exit__(self, *_: Any) -> None:
        self._over = True  # a generator may be closed in another thread, which cannot take the handler away
        if self._installed and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if self.interrupted or self._over:
            raise KeyboardInterrupt
        self.interrupted = True
        self.because(KeyboardInterrupt())
