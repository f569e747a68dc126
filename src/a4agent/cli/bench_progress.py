"""The live line of `a4 bench`: scored, failed, gIoU so far, samples a second, time left, dollars."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from a4agent.cli.common import messages, say

if TYPE_CHECKING:
    from rich.progress import Progress as Bar

    from a4agent.runs.bench import Progress

PLAIN_SECONDS = 30.0


class Display:
    """Shows progress on stderr: a bar in a terminal, a line every half minute in a log."""

    def __init__(self, title: str, progress: Progress) -> None:
        self._title = title
        self._started = time.monotonic()
        self._told = self._started
        self._bar = _bar() if messages.is_terminal else None
        self._task = self._bar and self._bar.add_task(
            title, total=progress.planned, completed=progress.planned - progress.left, words=words(progress, 0.0)
        )

    def __enter__(self) -> Display:
        if self._bar:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar:
            self._bar.stop()

    def update(self, progress: Progress) -> None:
        now = time.monotonic()
        done, text = progress.planned - progress.left, words(progress, now - self._started)
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=done, words=text)
        elif now - self._told > PLAIN_SECONDS:
            self._told = now
            say(f"{self._title}: {done} of {progress.planned}, {text}")


def words(progress: Progress, seconds: float) -> str:
    """ "gIoU 61.2, 3 failed, 1.4/s, 0:12:05 left, $0.37"."""
    parts = [f"gIoU {100 * progress.giou:.1f}"] if progress.scored else []
    if progress.failed or progress.unscored:
        parts.append(f"{progress.failed + len(progress.unscored)} failed")
    if progress.asked and seconds > 0:
        rate = progress.asked / seconds
        parts.append(f"{rate:.1f}/s" if rate >= 0.1 else f"{60 * rate:.1f}/min")
        parts.append(f"{_clock(progress.left / rate)} left")
    if progress.cost:
        parts.append(f"${progress.cost:.2f}")
    return ", ".join(parts)


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{seconds:02.0f}"


def _bar() -> Bar:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    # No title: it stands on the line above, and 80 columns have room for the figures alone.
    return Progress(
        BarColumn(bar_width=None),
        MofNCompleteColumn(),
        TextColumn("{task.fields[words]}"),
        console=messages,
        transient=True,
        expand=True,
    )
