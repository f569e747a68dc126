"""From a request's body to questions with decoded pictures.

A picture is bytes, never an address: this server fetches nothing for a caller.
"""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from a4agent.errors import InputError
from a4agent.imaging.load import TooManyPixels, load_image
from a4agent.serve.limits import Limits, Refused
from a4agent.types import Given, Target

if TYPE_CHECKING:
    from PIL.Image import Image

LONGEST_TEXT = 2000
FORM_FIELDS = ("image", "instruction", "part", "id")
_PLAIN = {"string_pattern_mismatch": "it is blank", "model_type": "a JSON object is expected"}
"""What pydantic says of two mistakes in words of its own."""

ModelT = TypeVar("ModelT", bound=BaseModel)
Text = Annotated[str, Field(min_length=1, max_length=LONGEST_TEXT, pattern=r"\S")]


class SampleIn(BaseModel):
    """A picture and what to do in it."""

    model_config = ConfigDict(extra="forbid")

    image: str = Field(
        min_length=1,
        description="The bytes of a JPEG, PNG, WebP, BMP, TIFF or GIF file in base64. Never a URL.",
        json_schema_extra={"format": "byte", "contentEncoding": "base64"},
    )
    instruction: Text = Field(examples=["drink from the mug"])
    part: Text | None = Field(
        None, description="The part, if you know it ('the handle of the mug'): only the Spotter runs."
    )
    id: str = Field("", max_length=200, description="Comes back with the answer.")


class BatchIn(BaseModel):
    """Samples to answer in one request; one that fails has the status `error`, the others are not touched."""

    model_config = ConfigDict(extra="forbid")

    samples: list[SampleIn] = Field(min_length=1)


@dataclass(frozen=True, eq=False)
class Question:
    """One sample: an upright RGB picture, what to do in it, and what is known already."""

    picture: Image
    instruction: str
    given: Given | None
    id: str = ""


@dataclass(frozen=True)
class Unusable:
    """A sample of a batch whose picture cannot be used, and why."""

    reason: str
    instruction: str
    id: str


def from_json(body: bytes, limits: Limits) -> Question:
    """The question of a JSON body.

    Raises:
        Refused: 400 not JSON, 413 too many pixels, 422 a field or a picture that cannot be used.
    """
    return _question(_validated(SampleIn, _parsed(body)), limits, limits.pixels)


def batch_from_json(body: bytes, limits: Limits) -> list[Question | Unusable]:
    """The samples of a batch; one whose picture cannot be used spoils no other.

    Raises:
        Refused: 400 not JSON, 422 a field that does not fit or too many samples.
    """
    batch = _validated(BatchIn, _parsed(body))
    if len(batch.samples) > limits.batch:
        raise Refused(422, f"a batch has at most {limits.batch} samples, not {len(batch.samples)}")
    questions: list[Question | Unusable] = []
    left = limits.batch_pixels
    for sample in batch.samples:
        try:
            question = _question(sample, limits, left)
        except Refused as refused:
            questions.append(Unusable(f"InputError: {refused.message}", sample.instruction, sample.id))
        else:
            left -= question.picture.width * question.picture.height
            questions.append(question)
    return questions


def from_form(fields: Mapping[str, object], image: bytes | None, limits: Limits) -> Question:
    """The question of a multipart form: its text fields, and the bytes of the file `image`.

    Raises:
        Refused: 413 too many pixels, 422 a field or a picture that cannot be used.
    """
    unknown = sorted(set(fields) - set(FORM_FIELDS))
    if unknown:
        raise Refused(422, f"unknown field {unknown[0][:50]!r}; known: {', '.join(FORM_FIELDS)}")
    if image is None:
        raise Refused(422, "the field 'image' is missing or has no file; send the picture as a file")
    return _with_picture(_validated(SampleIn, {**fields, "image": "a file"}), image, limits, limits.pixels)


def _parsed(body: bytes) -> Any:
    try:
        return json.loads(body)
    except (ValueError, RecursionError) as error:
        raise Refused(400, f"the body is not JSON: {str(error)[:200]}") from error


def _validated(model: type[ModelT], value: Any) -> ModelT:
    try:
        return model.model_validate(value)
    except ValidationError as error:
        first = error.errors(include_input=False, include_url=False, include_context=False)[0]
        place = ".".join(str(part)[:50] for part in first["loc"]) or "the body"
        raise Refused(422, f"{place}: {_PLAIN.get(first['type'], first['msg'])}") from error


def _question(sample: SampleIn, limits: Limits, left: int) -> Question:
    text = sample.image
    if "://" in text[:32]:
        raise Refused(422, "image: this server fetches no URLs; send the bytes of the picture in base64")
    if text.startswith("data:"):
        text = text.partition(",")[2]
    try:
        data = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError) as error:
        raise Refused(422, f"image: not base64 ({error})") from error
    return _with_picture(sample, data, limits, left)


def _with_picture(sample: SampleIn, data: bytes, limits: Limits, left: int) -> Question:
    try:
        picture = load_image(data, max_pixels=min(limits.pixels, left))
    except TooManyPixels as error:
        if left < limits.pixels:
            together = f"a batch may have {limits.batch_pixels} pixels in all; send this picture in another request"
            raise Refused(413, f"image: {together}, or smaller") from error
        raise Refused(413, f"image: more than {limits.pixels} pixels; send it smaller") from error
    except InputError as error:
        raise Refused(422, f"image: {error}") from error
    given = None if sample.part is None else Given(target=Target(sample.instruction, "", sample.part.strip()))
    return Question(picture, sample.instruction, given, sample.id)
