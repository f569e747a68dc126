"""When the agent is asked, and what a frame's answer is."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
from PIL import Image

from a4agent.agent import A4Agent
from a4agent.protocols import Tracked
from a4agent.stages.spotter import Spotter
from a4agent.testing import ScriptedDetector, ScriptedSegmenter
from a4agent.video.track import FoundFrame, track

FRAME = Image.new("RGB", (64, 48))
MASK = np.ones((48, 64), bool)


class Qualities:
    """A tracker that answers the given qualities, one a step."""

    def __init__(self, qualities: Iterable[float]) -> None:
        self._qualities = iter(qualities)
        self.started = 0

    def start(self, frame: Image.Image, mask: np.ndarray) -> None:
        self.started += 1

    def step(self, frame: Image.Image) -> Tracked:
        return Tracked(MASK, next(self._qualities))

    def close(self) -> None:
        return None


def run(qualities: Iterable[float], found: Iterable[bool], frames: int, every: int | None = None) -> list[FoundFrame]:
    detector = ScriptedDetector([[[8, 8, 30, 30]] if one else [] for one in found])
    agent = A4Agent(None, None, Spotter(detector, ScriptedSegmenter()))
    stream = ((index, FRAME) for index in range(frames))
    return list(track(agent, stream, "the handle", Qualities(qualities), every=every))


def sources(answers: list[FoundFrame]) -> list[str]:
    return [answer.source for answer in answers]


def test_it_is_grounded_once_and_followed() -> None:
    answers = run([0.9] * 9, [True], 10)
    assert sources(answers) == ["grounded"] + ["tracked"] * 9
    assert sum(answer.affordance is not None for answer in answers) == 1


def test_a_lost_part_is_grounded_again() -> None:
    assert sources(run([0.9, 0.1, 0.9], [True, True], 4)) == ["grounded", "tracked", "grounded", "tracked"]


def test_it_is_grounded_again_after_some_frames() -> None:
    answers = run([0.9] * 7, [True] * 3, 8, every=3)
    assert [answer.index for answer in answers if answer.source == "grounded"] == [0, 3, 6]


def test_what_is_not_found_is_asked_for_less_and_less() -> None:
    answers = run([], [False] * 10, 64)
    asked = [answer.index for answer in answers if answer.affordance is not None]
    assert asked == [0, 1, 3, 7, 15, 31, 47, 63]
    assert set(sources(answers)) == {"lost"}
    assert not any(answer.mask.any() for answer in answers)


def test_a_good_track_outlives_a_grounding_that_fails() -> None:
    assert sources(run([0.9] * 3, [True, False], 4, every=2)) == ["grounded", "tracked", "tracked", "tracked"]


def test_a_period_below_one_is_refused() -> None:
    with pytest.raises(Exception, match="1 frame or more"):
        run([], [], 1, every=0)
