"""The JSON of the HTTP API: questions as they come in, affordances and events as they go out.

A picture is bytes, never a URL: the server downloads nothing for a caller.
"""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from PIL import Image as Pillow
from PIL.Image import Image
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from a4agent.acting.lifting import Intrinsics, metres_of
from a4agent.acting.plan import ActionPlan, plan_action
from a4agent.errors import InputError, MissingExtraError
from a4agent.imaging.encode import encoded
from a4agent.imaging.load import TooManyPixels, load_image, read_pixels
from a4agent.redaction import redact
from a4agent.serve.admission import Limits, Refused, to_json
from a4agent.types import (
    Affordance,
    Check,
    Detection,
    Given,
    Imagination,
    Status,
    Step,
    Target,
    finite_or_none,
    rounded,
)

MaskForm = Literal["rle", "png", "none"]
PictureForm = Literal["none", "png"]
TraceForm = Literal["full", "calls", "none"]
LONGEST_TEXT = 2000
FORM_FIELDS = ("image", "instruction", "part", "id", "depth", "depth_scale", "camera")
FORM_FILES = ("image", "depth")
_PLAIN = {"string_pattern_mismatch": "it is blank", "model_type": "a JSON object is expected"}
"""Plain words for two of pydantic's messages."""

ModelT = TypeVar("ModelT", bound=BaseModel)
Text = Annotated[str, Field(min_length=1, max_length=LONGEST_TEXT, pattern=r"\S")]


class CameraIn(BaseModel):
    """A pinhole camera: focal lengths and principal point in pixels of the picture, as in ROS `CameraInfo`."""

    model_config = ConfigDict(extra="forbid")

    fx: float = Field(gt=0, lt=1e6, strict=True)
    fy: float = Field(gt=0, lt=1e6, strict=True)
    cx: float = Field(gt=-1e6, lt=1e6, strict=True)
    cy: float = Field(gt=-1e6, lt=1e6, strict=True)


class SampleIn(BaseModel):
    """A picture and what to do in it; with depth and a camera the answer has positions in metres and grasps."""

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
    depth: str | None = Field(
        None,
        description="A 16-bit PNG of the same size in base64, registered to the picture; 0 where nothing was measured.",
    )
    depth_scale: float = Field(0.001, gt=0, le=10, strict=True, description="Metres per unit of the depth.")
    camera: CameraIn | None = Field(None, description="Needed with `depth`.")


class BatchIn(BaseModel):
    """Samples to answer in one request; one that fails has the status `error`, the others are not touched."""

    model_config = ConfigDict(extra="forbid")

    samples: list[SampleIn] = Field(min_length=1)


class RleMask(BaseModel):
    """COCO run-length encoding: `counts` in columns from the top left, compressed as pycocotools does."""

    size: tuple[int, int] = Field(description="height, width")
    counts: str


class PngMask(BaseModel):
    """An 8-bit grey PNG: 255 on the part, 0 elsewhere."""

    size: tuple[int, int] = Field(description="height, width")
    png: str = Field(description="base64")


class ImaginationOut(BaseModel):
    prompt: str
    png: str | None = Field(None, description="base64; only where `imagination=png` was asked for")


class RegionOut(BaseModel):
    box_xyxy: tuple[float, float, float, float] | None
    points_xy: list[tuple[float, float]]
    mask: RleMask | PngMask | None = Field(description="null where this is the only region: see the answer's `mask`")
    score: float | None
    predicted_iou: float | None


class ContactOut(BaseModel):
    """A place to touch, in pixels; with depth also in metres in the camera's optical frame (x right, z forward)."""

    point_xy: tuple[float, float]
    clearance: float = Field(description="pixels from the mask's edge")
    position_xyz: tuple[float, float, float] | None
    normal_xyz: tuple[float, float, float] | None = Field(description="unit, towards the camera")
    approach_xyz: tuple[float, float, float] | None = Field(description="unit, into the surface")
    reachable: bool
    reason: str = Field(description="why it has no position or cannot be reached")


class GraspOut(BaseModel):
    """A parallel gripper's pose: rows of a 4 x 4 matrix; x closes, z approaches."""

    pose: list[tuple[float, float, float, float]]
    width: float = Field(description="metres")
    score: float
    contacts_xy: list[tuple[float, float]]


class ActionOut(BaseModel):
    """Where to touch and how to grasp, each best first."""

    frame_id: str
    contacts: list[ContactOut]
    grasps: list[GraspOut] = Field(description="empty without depth")
    reason: str = Field(description="why there are no grasps")


class AffordanceOut(BaseModel):
    """Pixels of the upright picture, x right, y down; boxes half-open. Nothing found is the status `empty`."""

    schema_: int = Field(alias="schema")
    id: str
    instruction: str
    size_wh: tuple[int, int]
    image_path: str | None = Field(description="where the caller had the picture, if that is known")
    profile: str | None
    version: str | None = Field(description="of a4agent")
    status: Status
    error: str | None
    confidence: float | None = Field(description="probability that the mask is right; null without a Verifier")
    checks: list[Check]
    target: Target | None
    imagination: ImaginationOut | None
    boxes_xyxy: list[tuple[float, float, float, float]]
    points_xy: list[tuple[float, float]]
    mask: RleMask | PngMask | None = Field(description="the union of the regions' masks")
    regions: list[RegionOut]
    trace: list[Step]
    action: ActionOut


class BatchOut(BaseModel):
    affordances: list[AffordanceOut] = Field(description="in the order of the samples")


class ErrorOut(BaseModel):
    error: str = Field(description="one sentence")


class HealthOut(BaseModel):
    status: str


class ReadyOut(BaseModel):
    status: str
    profile: str
    experts: list[str]
    verifies: bool = Field(description="whether answers have a confidence and may be `abstained`")
    workers: int


@dataclass(frozen=True, eq=False)
class Question:
    """One sample: an upright RGB picture, what to do in it, and what is known already."""

    picture: Image
    instruction: str
    given: Given | None
    id: str = ""
    depth: np.ndarray | None = None
    camera: Intrinsics | None = None

    def plan(self, affordance: Affordance) -> ActionPlan:
        """The contacts and grasps for the answer."""
        return plan_action(affordance, depth=self.depth, camera=self.camera)


@dataclass(frozen=True)
class Unusable:
    """A sample of a batch that cannot be answered, and why."""

    reason: str
    instruction: str
    id: str


def from_json(body: bytes, limits: Limits) -> Question:
    """The question of a JSON body.

    Raises:
        Refused: 400 not JSON, 413 too many pixels, 422 a field or a picture that cannot be used.
    """
    return _question(_validated(SampleIn, _parsed(body)), limits, limits.pixels)


def from_samples(samples: Sequence[SampleIn], limits: Limits) -> list[Question | Unusable]:
    """The questions of a batch, with an `Unusable` in place of each that has an unusable picture.

    Raises:
        Refused: 422 too many samples.
    """
    if len(samples) > limits.batch:
        raise Refused(422, f"a batch has at most {limits.batch} samples, not {len(samples)}")
    questions: list[Question | Unusable] = []
    left = limits.batch_pixels
    for sample in samples:
        try:
            question = _question(sample, limits, left)
        except Refused as refused:
            questions.append(Unusable(f"InputError: {refused.message}", sample.instruction, sample.id))
        else:
            left -= question.picture.width * question.picture.height
            questions.append(question)
    return questions


def from_form(fields: Mapping[str, object], files: Mapping[str, bytes], limits: Limits) -> Question:
    """The question of a multipart form: its text fields, and the bytes of the files `image` and `depth`.

    Raises:
        Refused: 413 too many pixels, 422 a field or a picture that cannot be used.
    """
    unknown = sorted(set(fields) - set(FORM_FIELDS))
    if unknown:
        raise Refused(422, f"unknown field {unknown[0][:50]!r}; known: {', '.join(FORM_FIELDS)}")
    if "image" not in files:
        raise Refused(422, "the field 'image' is missing or has no file; send the picture as a file")
    if "depth" in fields:
        raise Refused(422, "depth: send it as a file")
    given = {**fields, "image": "a file"}
    for name in {"camera", "depth_scale"} & set(fields):
        try:
            given[name] = json.loads(str(fields[name]))
        except (ValueError, RecursionError) as error:
            raise Refused(422, f"{name}: not JSON ({str(error)[:200]})") from error
    return _with_picture(_validated(SampleIn, given), files["image"], files.get("depth"), limits, limits.pixels)


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
        raise Refused(422, error_text(dict(first))) from error


def _question(sample: SampleIn, limits: Limits, left: int) -> Question:
    depth = None if sample.depth is None else _decoded("depth", sample.depth)
    return _with_picture(sample, _decoded("image", sample.image), depth, limits, left)


def _decoded(field: str, text: str) -> bytes:
    if "://" in text[:32]:
        raise Refused(422, f"{field}: this server fetches no URLs; send the bytes of the picture in base64")
    if text.startswith("data:"):
        text = text.partition(",")[2]
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError) as error:
        raise Refused(422, f"{field}: not base64 ({error})") from error


def _with_picture(sample: SampleIn, data: bytes, depth: bytes | None, limits: Limits, left: int) -> Question:
    try:
        picture = load_image(data, max_pixels=min(limits.pixels, left))
    except TooManyPixels as error:
        if left < limits.pixels:
            together = f"a batch may have {limits.batch_pixels} pixels in all; send this picture in another request"
            raise Refused(413, f"image: {together}, or smaller") from error
        raise Refused(413, f"image: more than {limits.pixels} pixels; send it smaller") from error
    except (InputError, MissingExtraError) as error:  # a format that needs an extra, such as HEIC
        raise Refused(422, f"image: {error}") from error
    given = None if sample.part is None else Given(target=Target(sample.instruction, "", sample.part.strip()))
    metres = None if depth is None else _metres(sample, depth, picture)
    camera = sample.camera and Intrinsics(**sample.camera.model_dump())
    return Question(picture, sample.instruction, given, sample.id, metres, camera)


def _metres(sample: SampleIn, depth: bytes, picture: Image) -> np.ndarray:
    """The depth (H, W) of a sample in metres, NaN where it was not measured."""
    if sample.camera is None:
        raise Refused(422, "camera: it is needed with a depth image")
    try:
        values = read_pixels(depth, max_pixels=picture.width * picture.height)
        if values.ndim != 2:
            raise InputError("a depth image has one channel, such as a 16-bit PNG")
        return metres_of(values, picture.size, sample.depth_scale)
    except (InputError, MissingExtraError) as error:
        raise Refused(422, f"depth: {error}") from error


def to_wire(
    affordance: Affordance,
    mask: MaskForm = "rle",
    imagination: PictureForm = "none",
    trace: TraceForm = "full",
    plan: ActionPlan | None = None,
) -> dict[str, Any]:
    """`affordance.to_dict()` in the forms that were asked for, without secrets, and the `action` for it.

    The mask of a single region is sent once, as the answer's `mask`.
    """
    data = affordance.to_dict()
    union = data.pop("mask")
    regions = data.pop("regions")
    data["imagination"] = None
    if trace != "full":
        short = ("prompt", "answer")
        calls = [{key: value for key, value in step.items() if key not in short} for step in data["trace"]]
        data["trace"] = calls if trace == "calls" else []
    data = redact(data)
    if affordance.imagination is not None:
        data["imagination"] = imagination_to_wire(affordance.imagination, imagination)
    masks = [region.mask for region in affordance.regions]
    forms = [_mask_to_wire(one, row["mask"], mask) for one, row in zip(masks, regions, strict=True)]
    if len(regions) == 1:
        forms, data["mask"] = [None], forms[0]
    else:
        data["mask"] = _mask_to_wire(affordance.mask, union, mask)
    for row, form in zip(regions, forms, strict=True):
        row["mask"] = form
        row["score"] = finite_or_none(row["score"])
    data["regions"] = regions
    data["action"] = (plan or plan_action(affordance)).to_dict()
    return data


def imagination_to_wire(imagination: Imagination, form: PictureForm) -> dict[str, Any]:
    """The edit prompt, and the picture as base64 PNG if it was asked for."""
    data: dict[str, Any] = {"prompt": redact(imagination.prompt)}
    if form == "png" and imagination.image is not None:
        data["png"] = _png(imagination.image.convert("RGB"))
    return data


def stage_to_wire(name: str, value: Any, imagination: PictureForm) -> dict[str, Any]:
    """What a stage found, as the data of its event."""
    if name == "imagination":
        return imagination_to_wire(value, imagination)
    if name == "target":
        return redact(asdict(value))
    found: Detection = value
    return {
        "boxes_xyxy": rounded(found.boxes_xyxy),
        "points_xy": rounded(found.points_xy),
        "scores": None if found.scores is None else [finite_or_none(round(float(x), 4)) for x in found.scores],
    }


def event(name: str, data: Any) -> bytes:
    """One server-sent event."""
    return b"event: " + name.encode() + b"\ndata: " + to_json(data) + b"\n\n"


def error_text(error: Mapping[str, Any]) -> str:
    """One error of pydantic as "samples.0.instruction: it is blank"."""
    place = ".".join(str(part)[:50] for part in error["loc"]) or "the body"
    return f"{place}: {_PLAIN.get(error['type'], error['msg'])}"


def _mask_to_wire(mask: np.ndarray, rle: dict[str, Any], form: MaskForm) -> dict[str, Any] | None:
    """A mask (H, W) in one form; PNG is {"size": [h, w], "png": base64}."""
    if form == "rle":
        return rle
    if form == "none":
        return None
    png = _png(Pillow.fromarray(mask.astype(np.uint8) * 255)) if mask.size else ""
    return {"size": rle["size"], "png": png}


def _png(image: Image) -> str:
    return base64.b64encode(encoded(image, "PNG")).decode("ascii")
