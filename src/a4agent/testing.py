"""Scripted experts for tests: answers are queued or computed, requests are kept.

    vlm = ScriptedVLM(["### Output\\n{...}"])                        # answers in order
    detector = ScriptedDetector(lambda request: Detection(...))        # or computed
    agent = A4Agent(None, Thinker(vlm), Spotter(detector, ScriptedSegmenter()))
    agent.predict(photo, "open the drawer")
    assert vlm.requests[0].text.startswith("Given the image")

An `A4Error` among the answers is returned in its place in the batch; any other exception is raised. Asking
more often than there are answers is an error. `seconds` is how long each call takes.
"""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Generic, TypeVar

import numpy as np

from a4agent.agent import A4Agent
from a4agent.errors import A4Error
from a4agent.protocols import (
    ChatAnswer,
    ChatRequest,
    DetectRequest,
    EditAnswer,
    EditRequest,
    ExpertBase,
    Segmentation,
    SegmentRequest,
)
from a4agent.stages.dreamer import Dreamer
from a4agent.stages.spotter import Spotter
from a4agent.stages.thinker import Thinker
from a4agent.types import Detection

RequestT = TypeVar("RequestT")
ScriptedAnswerT = TypeVar("ScriptedAnswerT")


class Script(ExpertBase, Generic[RequestT, ScriptedAnswerT]):
    """What the scripted experts share. `requests` holds every request, `batches` their counts a call."""

    def __init__(
        self,
        answers: Iterable[Any] | Callable[[RequestT], Any],
        *,
        id: str = "scripted:expert",
        seconds: float = 0.0,
        max_batch: int = 1,
        concurrency: int = 1,
    ) -> None:
        super().__init__(id, max_batch=max_batch, concurrency=concurrency)
        self._compute = answers if callable(answers) else None
        self._queue: deque[Any] = deque() if callable(answers) else deque(answers)
        self._lock = threading.Lock()
        self.seconds = seconds
        self.requests: list[RequestT] = []
        self.batches: list[int] = []
        self.closed = False

    def _answer(self, requests: Sequence[RequestT], wrap: Callable[[Any], Any]) -> list[ScriptedAnswerT | A4Error]:
        with self._lock:
            self.requests.extend(requests)
            self.batches.append(len(requests))
        if self.seconds:
            time.sleep(self.seconds)
        answers: list[Any] = []
        for request in requests:
            answer = self._compute(request) if self._compute else self._next()
            if isinstance(answer, Exception) and not isinstance(answer, A4Error):
                raise answer
            answers.append(answer if isinstance(answer, A4Error) else wrap(answer))
        return answers

    def _next(self) -> Any:
        with self._lock:
            if not self._queue:
                raise AssertionError(f"{self.id} was asked {len(self.requests)} times, more often than it has answers")
            return self._queue.popleft()

    def close(self) -> None:
        self.closed = True


class ScriptedVLM(Script[ChatRequest, ChatAnswer]):
    """Answers are `ChatAnswer`s or texts."""

    def chat(self, requests: Sequence[ChatRequest]) -> list[ChatAnswer | A4Error]:
        return self._answer(requests, lambda answer: ChatAnswer(answer) if isinstance(answer, str) else answer)


class ScriptedEditor(Script[EditRequest, EditAnswer]):
    """Answers are `EditAnswer`s or images; without a script the picture comes back as it is."""

    def __init__(self, answers: Any = None, **settings: Any) -> None:
        super().__init__(answers if answers is not None else (lambda request: request.image), **settings)

    def edit(self, requests: Sequence[EditRequest]) -> list[EditAnswer | A4Error]:
        return self._answer(requests, lambda answer: answer if isinstance(answer, EditAnswer) else EditAnswer(answer))


class ScriptedDetector(Script[DetectRequest, Detection]):
    """Answers are `Detection`s, or lists of boxes; without a script the middle half of the picture."""

    def __init__(self, answers: Any = None, **settings: Any) -> None:
        super().__init__(answers if answers is not None else _middle, **settings)

    def detect(self, requests: Sequence[DetectRequest]) -> list[Detection | A4Error]:
        return self._answer(requests, lambda answer: answer if isinstance(answer, Detection) else _boxes(answer))


class ScriptedSegmenter(Script[SegmentRequest, Segmentation]):
    """Answers are `Segmentation`s; without a script each box is filled, and a square drawn around lone points."""

    def __init__(self, answers: Any = None, **settings: Any) -> None:
        super().__init__(answers if answers is not None else fill_boxes, **settings)

    def segment(self, requests: Sequence[SegmentRequest]) -> list[Segmentation | A4Error]:
        return self._answer(requests, lambda answer: answer)


def output(object_part: str, object_name: str = "thing", task: str = "", thinking: str = "It fits the task.") -> str:
    """A well-formed answer to the Thinker's prompt."""
    answer = {"task": task, "object_name": object_name, "object_part": object_part}
    return f"### Thinking\n{thinking}\n### Output\n{json.dumps(answer, indent=4)}"


def scripted_agent(part: str = "the handle of the thing", *, dream: bool = False, **settings: Any) -> A4Agent:
    """An agent of scripted experts that answers `part` and marks the middle of every picture."""
    vlm = ScriptedVLM(lambda request: output(part) if "### Output" in request.text else "Edit it.", **settings)
    dreamer = Dreamer(vlm, ScriptedEditor(**settings)) if dream else None
    return A4Agent(dreamer, Thinker(vlm), Spotter(ScriptedDetector(**settings), ScriptedSegmenter(**settings)))


def fill_boxes(request: SegmentRequest) -> Segmentation:
    """Each prompt's box filled; 9 x 9 pixels around its points where it has none."""
    width, height = request.image.size
    masks = np.zeros((len(request.prompts), 1, height, width), dtype=bool)
    for mask, prompt in zip(masks, request.prompts, strict=True):
        boxes = (
            [prompt.box_xyxy]
            if prompt.box_xyxy is not None
            else [[x - 4, y - 4, x + 5, y + 5] for x, y in prompt.points_xy]
        )
        for box in boxes:
            x0, y0, x1, y1 = (max(round(float(edge)), 0) for edge in box)
            mask[0, y0:y1, x0:x1] = True
    return Segmentation(masks, np.full((len(request.prompts), 1), 0.9, np.float32))


def _boxes(boxes: Any) -> Detection:
    return Detection(np.array(boxes, np.float32).reshape(-1, 4))


def _middle(request: DetectRequest) -> Detection:
    width, height = request.image.size
    box = np.array([[width / 4, height / 4, width * 3 / 4, height * 3 / 4]], np.float32)
    return Detection(box, (box[:, :2] + box[:, 2:]) / 2)
