"""Stages ask models through a `Recorder`, which keeps a step for every call."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any, cast, overload

from a4agent.errors import A4Error, ProviderError
from a4agent.prompts import text_hash
from a4agent.protocols import (
    Answer,
    ChatAnswer,
    ChatRequest,
    Detector,
    DetectRequest,
    EditAnswer,
    EditRequest,
    Expert,
    ImageEditor,
    Request,
    Segmentation,
    Segmenter,
    SegmentRequest,
    VisionLanguageModel,
    ask,
)
from a4agent.types import Detection, Step, Trace, Usage

KINDS: dict[str, type[Answer]] = {
    "chat": ChatAnswer,
    "edit": EditAnswer,
    "detect": Detection,
    "segment": Segmentation,
}


class Recorder:
    """Asks an expert one request at a time and keeps the steps, including those of failed calls."""

    def __init__(self) -> None:
        self._steps: list[Step] = []

    @property
    def trace(self) -> Trace:
        return Trace(tuple(self._steps))

    def mark(self, error: A4Error) -> None:
        """Note in the last step that its answer could not be used, unless the call itself failed."""
        if self._steps and not self._steps[-1].error:
            self._steps[-1] = replace(self._steps[-1], error=_named(error))

    @overload
    def ask(self, stage: str, expert: VisionLanguageModel, request: ChatRequest) -> ChatAnswer: ...
    @overload
    def ask(self, stage: str, expert: ImageEditor, request: EditRequest) -> EditAnswer: ...
    @overload
    def ask(self, stage: str, expert: Detector, request: DetectRequest) -> Detection: ...
    @overload
    def ask(self, stage: str, expert: Segmenter, request: SegmentRequest) -> Segmentation: ...

    def ask(self, stage: str, expert: Expert, request: Request) -> Answer:
        """One request, one answer, one step.

        Raises:
            A4Error: the expert raised it or returned it for this request.
            ProviderError: the expert failed in a way it did not foresee.
        """
        started = time.perf_counter()
        try:
            answer = ask(expert, [request])[0]
            if isinstance(answer, A4Error):
                raise answer
            text, usage = _text_of(_checked(answer, request)), answer.usage
        except Exception as error:
            spent: Usage = getattr(error, "usage", None) or Usage()
            attempts = int(getattr(error, "attempts", 1))
            seconds = time.perf_counter() - started
            self._keep(stage, expert, request, replace(spent, seconds=seconds, attempts=attempts), error=_named(error))
            if isinstance(error, A4Error):
                raise
            raise ProviderError(f"{expert.id} failed on a {request.verb} request: {error!r}") from error
        usage = replace(usage, seconds=usage.seconds or time.perf_counter() - started)
        self._keep(stage, expert, request, usage, answer=text, cut_off=_is_cut_off(answer))
        return answer

    def _keep(self, stage: str, expert: Expert, request: Request, usage: Usage, **outcome: Any) -> None:
        prompt = _prompt_of(request)
        hashed = text_hash(prompt, getattr(request, "system", None))
        step = Step(stage, request.role, expert.id, prompt=prompt, prompt_hash=hashed, **vars(usage), **outcome)
        self._steps.append(step)


def _checked(answer: Answer, request: Request) -> Answer:
    """The answer, if it has the type that was asked for; experts of other packages may be untyped."""
    kind = KINDS[request.verb]
    if not isinstance(answer, kind):
        raise TypeError(f"expected a {kind.__name__}, not a {type(answer).__name__}")
    if isinstance(answer, ChatAnswer) and not isinstance(cast(Any, answer.text), str):
        raise TypeError(f"the text of a ChatAnswer must be a string, not {type(answer.text).__name__}")
    return answer


def _named(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


def _is_cut_off(answer: Answer) -> bool:
    if isinstance(answer, ChatAnswer):
        return answer.finish_reason == "length"
    return isinstance(answer, Detection) and answer.cut_off


def _prompt_of(request: Request) -> str:
    if isinstance(request, ChatRequest):
        return request.text
    if isinstance(request, EditRequest):
        return request.prompt
    if isinstance(request, DetectRequest):
        return request.phrase
    prompts = [{"box": _listed(p.box_xyxy), "points": _listed(p.points_xy)} for p in request.prompts]
    return str(prompts)


def _listed(array: Any) -> Any:
    return None if array is None else [round(float(x), 1) for x in array.ravel()]


def _text_of(answer: Answer) -> str:
    if isinstance(answer, ChatAnswer):
        return f"{answer.reasoning}\n\n{answer.text}" if answer.reasoning else answer.text
    if isinstance(answer, EditAnswer):
        return f"an image of {answer.image.width} x {answer.image.height}"
    if isinstance(answer, Detection):
        return answer.text or f"{len(answer.boxes_xyxy)} boxes, {len(answer.points_xy)} points"
    return (
        f"{answer.masks.shape[0]} prompts, predicted IoU {[round(float(x), 3) for x in answer.predicted_iou.max(-1)]}"
    )
