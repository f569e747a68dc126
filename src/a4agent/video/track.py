"""Ground once, then follow: the part in every frame at a fraction of the calls.

    with open_frames("kitchen.mp4") as frames:
        for found in track(agent, frames, "open the drawer", create("flow")):
            found.index, found.source, found.mask         # 0 grounded, 1 tracked, 2 tracked, ...

The part is grounded again when the tracker loses it, or after `every` frames. A grounding that is not accepted
(empty, or too uncertain for the profile's verifier) is retried after 1, 2, 4, ... frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from PIL.Image import Image

from a4agent.agent import A4Agent
from a4agent.errors import InputError
from a4agent.protocols import Tracker
from a4agent.types import Affordance

LONGEST_PAUSE = 16
"""In frames, between two groundings that were not accepted."""

Origin = Literal["grounded", "tracked", "lost"]


@dataclass(frozen=True, eq=False)
class FoundFrame:
    """One frame's answer: `mask` (H, W) bool, blank when lost.

    `quality` is the tracker's, or the confidence of a grounding (None without a verifier). `affordance` is set in
    frames where the agent was asked, also when its answer was not accepted.
    """

    index: int
    frame: Image
    mask: np.ndarray
    source: Origin
    quality: float | None = None
    affordance: Affordance | None = None


def track(
    agent: A4Agent,
    frames: Iterable[tuple[int, Image]],
    instruction: str,
    tracker: Tracker,
    *,
    lost_below: float = 0.4,
    every: int | None = None,
) -> Iterator[FoundFrame]:
    """Find the part in each frame.

    Args:
        lost_below: the tracker's quality under which the part is grounded again.
        every: ground again after at most this many frames; None for no limit.

    Raises:
        UserError: a key, model or setting is missing.
    """
    if every is not None and every < 1:
        raise InputError(f"ground again after 1 frame or more, not {every!r}")
    following, age, next_try, pause = False, 0, 0, 1
    for index, frame in frames:
        mask, quality = np.zeros(frame.size[::-1], bool), 0.0
        if following:
            tracked = tracker.step(frame)
            mask, quality, age = tracked.mask, tracked.quality, age + 1
            following = bool(quality >= lost_below and mask.any())
            if following and (every is None or age < every):
                yield FoundFrame(index, frame, mask, "tracked", quality)
                continue
        if index < next_try:
            yield _unaccepted(index, frame, mask, following, quality, None)
            continue
        affordance = agent.predict(frame, instruction)
        if affordance.status == "ok":
            tracker.start(frame, affordance.mask)
            following, age, pause, next_try = True, 0, 1, 0
            yield FoundFrame(index, frame, affordance.mask, "grounded", affordance.confidence, affordance)
        else:
            next_try, pause = index + pause, min(2 * pause, LONGEST_PAUSE)
            yield _unaccepted(index, frame, mask, following, quality, affordance)


def _unaccepted(
    index: int, frame: Image, mask: np.ndarray, following: bool, quality: float, affordance: Affordance | None
) -> FoundFrame:
    """The tracked mask while it is still good, else a blank one."""
    if following:
        return FoundFrame(index, frame, mask, "tracked", quality, affordance)
    return FoundFrame(index, frame, np.zeros_like(mask), "lost", quality, affordance)
