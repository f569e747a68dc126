"""The fields that a line of samples.jsonl must have. Run folders travel, so each line is checked."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, NonNegativeInt, ValidationError, model_validator

from a4agent.errors import first_problem
from a4agent.types import SCHEMA, Status

Size = Annotated[list[NonNegativeInt], Field(min_length=2, max_length=2)]
Box = Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]
Point = Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)]


class _Part(BaseModel):
    model_config = ConfigDict(strict=True)


class _Mask(_Part):
    size: Size
    counts: str


class _Target(_Part):
    task: str
    object_name: str
    object_part: str
    thinking: str


class _Imagination(_Part):
    prompt: str


class _Check(_Part):
    name: str
    value: FiniteFloat | None
    note: str


class _Step(_Part):
    stage: str
    role: str
    expert: str
    seconds: FiniteFloat
    cached: bool
    cost: FiniteFloat | None
    answer: str


class _Line(_Part):
    id: str
    instruction: str
    size_wh: Size
    status: Status
    error: str | None
    confidence: Annotated[FiniteFloat, Field(ge=0, le=1)] | None
    checks: list[_Check]
    target: _Target | None
    imagination: _Imagination | None
    boxes_xyxy: list[Box]
    points_xy: list[Point]
    mask: _Mask
    regions: list[dict[str, Any]]
    trace: list[_Step]
    intersection: NonNegativeInt
    union: NonNegativeInt
    truth: _Mask
    truth_pixels: NonNegativeInt | None = None
    prediction_pixels: NonNegativeInt | None = None
    measures: dict[str, FiniteFloat | None] = {}
    category: str | None = None
    tags: dict[str, str] | None = None
    pictures: dict[str, str] | None = None

    @model_validator(mode="after")
    def _possible(self) -> _Line:
        if self.intersection > self.union:
            raise ValueError(f"intersection {self.intersection} is larger than union {self.union}")
        return self


def problem_of(row: Any) -> str:
    """Why a JSON value is not a line as this version writes it; "" if it is one."""
    if not isinstance(row, dict):
        return "it is not a JSON object"
    schema: Any = row.get("schema")  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
    if schema != SCHEMA:
        return f"it has schema {schema!r}, and this version reads {SCHEMA}"
    try:
        _Line.model_validate(row)
    except ValidationError as error:
        return first_problem(error, "the line")
    return ""
