"""What goes over the wire: an affordance as JSON, as documented by the OpenAPI schema, and the events of a stream."""

from __future__ import annotations

import base64
import io
import json
import math
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from a4agent.imaging.masks import decode_rle
from a4agent.types import Affordance, Imagination

if TYPE_CHECKING:
    from PIL.Image import Image

MaskForm = Literal["rle", "png", "none"]
PictureForm = Literal["none", "png"]


class RleMask(BaseModel):
    """COCO run-length encoding: `counts` in columns from the top left, compressed as pycocotools does."""

    size: tuple[int, int] = Field(description="height, width")
    counts: str


class PngMask(BaseModel):
    """An 8-bit grey PNG: 255 on the part, 0 elsewhere."""

    size: tuple[int, int] = Field(description="height, width")
    png: str = Field(description="base64")


class TargetOut(BaseModel):
    task: str
    object_name: str
    object_part: str = Field(examples=["the handle of the mug"])
    thinking: str


class ImaginationOut(BaseModel):
    prompt: str
    png: str | None = Field(None, description="base64; only where `imagination=png` was asked for")


class RegionOut(BaseModel):
    box_xyxy: tuple[float, float, float, float] | None
    points_xy: list[tuple[float, float]]
    mask: RleMask | PngMask | None
    score: float | None
    predicted_iou: float | None


class CheckOut(BaseModel):
    """One thing that the Verifier looked at: 0 is bad, 1 is good, null could not be measured."""

    name: str
    value: float | None
    note: str
    blame: str


class StepOut(BaseModel):
    """One model call."""

    model_config = ConfigDict(extra="allow")

    stage: str
    role: str
    expert: str
    seconds: float


class AffordanceOut(BaseModel):
    """Pixels of the upright picture, x right, y down; boxes half-open. Nothing found is the status `empty`."""

    schema_: int = Field(alias="schema")
    id: str
    instruction: str
    size_wh: tuple[int, int]
    image_path: str | None = Field(description="where the caller had the picture, if that is known")
    profile: str | None
    version: str | None = Field(description="of a4agent")
    status: Literal["ok", "abstained", "empty", "invalid", "error"]
    error: str | None
    confidence: float | None = Field(description="probability that the mask is right; null without a Verifier")
    checks: list[CheckOut]
    target: TargetOut | None
    imagination: ImaginationOut | None
    boxes_xyxy: list[tuple[float, float, float, float]]
    points_xy: list[tuple[float, float]]
    mask: RleMask | PngMask | None = Field(description="the union of the regions' masks")
    regions: list[RegionOut]
    trace: list[StepOut]


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
    workers: int


def to_wire(affordance: Affordance, mask: MaskForm = "rle", imagination: PictureForm = "none") -> dict[str, Any]:
    """`affordance.to_dict()` with its masks in the form that was asked for, and the imagined picture if it was."""
    data = affordance.to_dict()
    for region in data["regions"]:
        for name in ("score", "predicted_iou"):
            if region[name] is not None and not math.isfinite(region[name]):
                region[name] = None
    if mask != "rle":
        for holder in (data, *data["regions"]):
            holder["mask"] = png_mask(decode_rle(holder["mask"])) if mask == "png" else None
    if affordance.imagination is not None:
        data["imagination"] = imagination_to_wire(affordance.imagination, imagination)
    return data


def imagination_to_wire(imagination: Imagination, form: PictureForm) -> dict[str, Any]:
    """The edit prompt, and the picture as base64 PNG if it was asked for."""
    data: dict[str, Any] = {"prompt": imagination.prompt}
    if form == "png" and imagination.image is not None:
        data["png"] = _png(imagination.image.convert("RGB"))
    return data


def stage_to_wire(name: str, value: Any, imagination: PictureForm) -> dict[str, Any]:
    """What a stage found, as the data of its event."""
    if name == "imagination":
        return imagination_to_wire(value, imagination)
    if name == "target":
        return TargetOut.model_validate(value, from_attributes=True).model_dump()
    return {
        "boxes_xyxy": _rounded(value.boxes_xyxy),
        "points_xy": _rounded(value.points_xy),
        "scores": None if value.scores is None else [_score(score) for score in value.scores],
    }


def png_mask(mask: np.ndarray) -> dict[str, Any]:
    """A mask (H, W) as {"size": [h, w], "png": base64}."""
    from PIL import Image

    height, width = mask.shape
    png = _png(Image.fromarray(mask.astype(np.uint8) * 255)) if mask.size else ""
    return {"size": [int(height), int(width)], "png": png}


def event(name: str, data: Any) -> bytes:
    """One server-sent event."""
    return f"event: {name}\ndata: {dumps(data)}\n\n".encode()


def dumps(data: Any) -> str:
    """Compact JSON on one line; NaN and infinity, which are not JSON, never leave the server."""
    return json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"))


def _png(image: Image) -> str:
    file = io.BytesIO()
    image.save(file, "PNG")
    return base64.b64encode(file.getvalue()).decode("ascii")


def _score(score: float) -> float | None:
    return round(float(score), 4) if math.isfinite(score) else None


def _rounded(array: np.ndarray) -> list[Any]:
    return np.round(array.astype(np.float64), 2).tolist()
