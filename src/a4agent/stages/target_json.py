"""Read the Thinker's answer: JSON within prose or fences, with trailing commas, or given more than once.

### Thinking
The mug's body is hot, so ...
### Output
{"task": "drink from the mug", "object_name": "mug", "object_part": "the handle of the mug"}
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from a4agent.errors import UnreadableAnswer
from a4agent.types import Target

OUTPUT = re.compile(r"^[ \t>*_]*#{1,6}[ \t*_]*output\b[\s*_:]*", re.IGNORECASE | re.MULTILINE)
THINKING = re.compile(r"^[ \t>*_]*#{1,6}[ \t*_]*thinking\b[\s*_:]*", re.IGNORECASE | re.MULTILINE)
FENCE = re.compile(r"```\w*\Z")
TRAILING_COMMA = re.compile(r'("(?:[^"\\\n]|\\.)*"?)|,(?=\s*[}\]])')  # a stray quote in prose ends with its line
LONGEST = 200_000
"""In characters; of a longer answer the end is read."""
MAX_OPENINGS = 300


class TargetAnswer(BaseModel):
    """The JSON that the Thinker's template asks for, as a schema for constrained decoding (`thinking` comes first)."""

    model_config = ConfigDict(str_strip_whitespace=True)

    thinking: str = ""
    task: str = ""
    object_name: str = Field(min_length=1, max_length=200)
    object_part: str = Field(min_length=1, max_length=400)

    @field_validator("task", "thinking", mode="before")
    @classmethod
    def _none_as_blank(cls, value: Any) -> Any:
        return "" if value is None else value

    @field_validator("object_name", "object_part")
    @classmethod
    def _is_an_answer(cls, value: str) -> str:
        if "[object part]" in value or value.lower() == "the name of the object":
            raise ValueError("this repeats the template instead of naming a part")
        return value


def read_target(text: str) -> Target:
    """The target that a Thinker's answer names: of several valid JSON objects, the last.

    A list counts as its first valid element.

    Raises:
        UnreadableAnswer: no valid object; the message is the reason, in words that can be sent back to the model.
    """
    text = text[-LONGEST:]
    if not text.strip():
        raise UnreadableAnswer("the answer was empty")
    output = list(OUTPUT.finditer(text))
    searched = text[output[-1].end() :] if output else text
    reasons: list[str] = []
    found = _last_valid(searched, reasons)
    if found is None and output:
        found = _last_valid(text, reasons)
    if found is None:
        raise UnreadableAnswer(reasons[-1] if reasons else "the answer held no JSON object")
    return Target(
        task=found.task,
        object_name=found.object_name,
        object_part=found.object_part,
        thinking=found.thinking or _thinking(text, output[-1].start() if output else None),
    )


def _last_valid(text: str, reasons: list[str]) -> TargetAnswer | None:
    last: TargetAnswer | None = None
    for value in json_values(text):
        for item in value if isinstance(value, list) else [value]:
            try:
                last = TargetAnswer.model_validate(item)
                break
            except ValidationError as error:
                reasons.append(_reason(error))
    return last


def _reason(error: ValidationError) -> str:
    first = error.errors()[0]
    place = ".".join(str(part) for part in first["loc"]) or "the JSON value"
    if first["type"] == "string_too_short":
        return f"{place} is empty"
    return f"{place}: {first['msg']}"


def _thinking(text: str, end: int | None) -> str:
    before = (
        text[:end] if end is not None else FENCE.sub("", text[: max(text.find("{"), 0)].rstrip().rstrip("[").rstrip())
    )
    heading = THINKING.search(before)
    return (before[heading.end() :] if heading else before).strip()


def thinking_in(text: str) -> str:
    """The prose of an answer: the text under "### Thinking", or before the output."""
    text = text[-LONGEST:]
    output = list(OUTPUT.finditer(text))
    return _thinking(text, output[-1].start() if output else len(text))


def json_values(text: str) -> Iterator[dict[str, Any] | list[Any]]:
    """All outermost JSON objects and lists in a text, in order; trailing commas and raw line breaks allowed."""
    decoder = json.JSONDecoder(strict=False)
    text = text[-LONGEST:]
    text = TRAILING_COMMA.sub(lambda match: match.group(1) or "", text)
    place, tried = 0, 0
    while tried < MAX_OPENINGS:
        opening = re.compile(r"[{\[]").search(text, place)
        if opening is None:
            return
        tried += 1
        try:
            value, place = decoder.raw_decode(text, opening.start())
        except (ValueError, RecursionError):  # not JSON, or a number of thousands of digits
            place = opening.start() + 1
            continue
        yield value
