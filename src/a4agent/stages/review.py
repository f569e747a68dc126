"""The signal "review": a vision-language model looks at the answer drawn over the picture and at a crop of it.

{"thing_there": 1.0, "right_part": 0.2, "right_count": 1.0, "tight": 0.9,
 "blame": "spotter", "advice": "The handle is on the left of the mug."}
"""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from a4agent import prompts
from a4agent.errors import UnreadableAnswer
from a4agent.imaging import overlay
from a4agent.protocols import ChatRequest
from a4agent.stages.signals import Evidence, crop_around
from a4agent.stages.target_json import json_values
from a4agent.types import Check

QUESTIONS = {
    "thing_there": ("the object is in the picture", "thinker"),
    "right_part": ("the mask is on the right part", "spotter"),
    "right_count": ("all parts are marked and no others", "spotter"),
    "tight": ("the mask follows the outline", "spotter"),
}
"""What is asked, in the words of a check, and which stage a bad answer blames unless the model names one."""
BLAMED = ("dreamer", "thinker", "spotter")
LONGEST_ADVICE = 300


class ReviewAnswer(BaseModel):
    """The JSON that the review's prompt asks for; yes and no count as 1 and 0."""

    model_config = ConfigDict(str_strip_whitespace=True)

    thing_there: float = Field(ge=0, le=1)
    right_part: float = Field(ge=0, le=1)
    right_count: float = Field(ge=0, le=1)
    tight: float = Field(ge=0, le=1)
    blame: str = ""
    advice: str = ""

    @field_validator(*QUESTIONS, mode="before")
    @classmethod
    def _as_number(cls, value: Any) -> Any:
        words = {"yes": 1.0, "true": 1.0, "no": 0.0, "false": 0.0}
        return words.get(value.strip().lower(), value) if isinstance(value, str) else value

    @field_validator("blame", "advice", mode="before")
    @classmethod
    def _as_text(cls, value: Any) -> Any:
        return "" if value is None else value


class Review:
    """One call of `verifier.vlm` for each answer."""

    name: ClassVar[str] = "review"
    needs: ClassVar[tuple[str, ...]] = ("vlm",)

    def measure(self, evidence: Evidence) -> list[Check]:
        """The four checks; the worst one carries the model's blame and advice.

        Raises:
            UnreadableAnswer: the answer is not the JSON that was asked for.
        """
        assert evidence.vlm is not None
        answer = evidence.affordance
        drawn = overlay.draw(evidence.image, answer.regions)
        frame = crop_around(answer.mask, margin=0.5)
        closer = evidence.image if frame is None else evidence.image.crop(frame)
        text = prompts.fill(prompts.load(evidence.prompts, "review"), answer.instruction)
        request = ChatRequest(
            images=(drawn, closer),
            text=text.replace('"PART"', f'"{answer.phrase}"'),
            schema=ReviewAnswer.model_json_schema(),
            max_tokens=evidence.max_tokens,
        )
        reply = evidence.recorder.ask("verifier", evidence.vlm, request)
        return _checks(read_review(reply.text))


def read_review(text: str) -> ReviewAnswer:
    """The review in a model's answer: of several valid JSON objects, the last.

    Raises:
        UnreadableAnswer: there is none.
    """
    found: ReviewAnswer | None = None
    for value in json_values(text):
        try:
            found = ReviewAnswer.model_validate(value)
        except ValidationError:
            continue
    if found is None:
        raise UnreadableAnswer(f"the review is not the JSON that was asked for: {text[:120]!r}")
    return found


def _checks(review: ReviewAnswer) -> list[Check]:
    values = {name: float(getattr(review, name)) for name in QUESTIONS}
    worst = min(values, key=lambda name: values[name])
    checks: list[Check] = []
    for name, (words, blame) in QUESTIONS.items():
        note = f"{words}: {values[name]:.0%}"
        if name == worst:
            blame = review.blame if review.blame in BLAMED else blame
            note = review.advice[:LONGEST_ADVICE] or note
        checks.append(Check(name, values[name], note, blame))
    return checks
