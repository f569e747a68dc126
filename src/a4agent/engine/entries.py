"""An answer as bytes and back: a line of JSON with a checksum, then the PNG if the answer is a picture. No pickle."""

from __future__ import annotations

import hashlib
import io
import json
from dataclasses import asdict
from typing import Any

import numpy as np

from a4agent.errors import DataError
from a4agent.imaging.masks import decode_rle, encode_rle
from a4agent.protocols import Answer, ChatAnswer, EditAnswer, Segmentation
from a4agent.redaction import redact
from a4agent.types import Detection, Usage


def pack(answer: Answer) -> bytes:
    """The bytes of an answer; `unpack` gives an equal one."""
    picture = b""
    fields: dict[str, Any] = {"kind": type(answer).__name__, "usage": asdict(answer.usage)}
    if isinstance(answer, ChatAnswer):
        fields |= {"text": answer.text, "reasoning": answer.reasoning, "finish_reason": answer.finish_reason}
    elif isinstance(answer, EditAnswer):
        buffer = io.BytesIO()
        answer.image.convert("RGB").save(buffer, "PNG", compress_level=1)
        picture = buffer.getvalue()
    elif isinstance(answer, Detection):
        fields |= {
            "boxes_xyxy": _listed(answer.boxes_xyxy),
            "points_xy": _listed(answer.points_xy),
            "scores": None if answer.scores is None else _listed(answer.scores),
            "points_derived": answer.points_derived,
            "masks": None if answer.masks is None else [encode_rle(mask) for mask in answer.masks],
            "masks_shape": None if answer.masks is None else list(answer.masks.shape),
            "text": answer.text,
            "cut_off": answer.cut_off,
        }
    else:
        height, width = answer.masks.shape[2:]
        fields |= {
            "masks": [encode_rle(mask) for mask in answer.masks.reshape(-1, height, width)],
            "masks_shape": list(answer.masks.shape),
            "predicted_iou": _listed(answer.predicted_iou),
        }
    body = json.dumps(redact(fields)).encode() + b"\n" + picture
    return hashlib.sha256(body).hexdigest().encode() + b"\n" + body


def unpack(data: bytes) -> Answer | None:
    """The answer in `data`, None if the bytes are not what `pack` wrote."""
    checksum, _, body = data.partition(b"\n")
    if hashlib.sha256(body).hexdigest().encode() != checksum:
        return None
    line, _, picture = body.partition(b"\n")
    try:
        return _answer(json.loads(line), picture)
    except (ValueError, KeyError, TypeError, OSError, DataError):
        return None


def _answer(fields: dict[str, Any], picture: bytes) -> Answer | None:
    usage = Usage(**fields["usage"])
    match fields["kind"]:
        case "ChatAnswer":
            return ChatAnswer(fields["text"], fields["reasoning"], fields["finish_reason"], usage)
        case "EditAnswer":
            from PIL import Image

            with Image.open(io.BytesIO(picture)) as image:
                image.load()
                return EditAnswer(image.copy(), usage)
        case "Detection":
            scores = fields["scores"]
            return Detection(
                boxes_xyxy=_array(fields["boxes_xyxy"]),
                points_xy=_array(fields["points_xy"]),
                scores=None if scores is None else _array(scores),
                points_derived=fields["points_derived"],
                masks=None if fields["masks"] is None else _masks(fields),
                text=fields["text"],
                cut_off=fields["cut_off"],
                usage=usage,
            )
        case "Segmentation":
            return Segmentation(_masks(fields), _array(fields["predicted_iou"]), usage)
        case _:
            return None


def _listed(array: np.ndarray) -> dict[str, Any]:
    return {"shape": list(array.shape), "dtype": str(array.dtype), "values": array.ravel().tolist()}


def _array(stored: dict[str, Any]) -> np.ndarray:
    return np.array(stored["values"], dtype=np.dtype(stored["dtype"])).reshape(stored["shape"])


def _masks(fields: dict[str, Any]) -> np.ndarray:
    shape = fields["masks_shape"]
    if not fields["masks"]:
        return np.zeros(shape, bool)
    return np.stack([decode_rle(mask) for mask in fields["masks"]]).reshape(shape)
