from __future__ import annotations

import base64
import io
import json

import numpy as np
import pytest
from PIL import Image

from a4agent.serve import wire
from a4agent.types import Affordance, Detection, Imagination, Region, Target


def affordance(score: float | None = 0.5) -> Affordance:
    mask = np.zeros((20, 30), bool)
    mask[2:6, 4:9] = True
    region = Region(np.array([4, 2, 9, 6], np.float32), np.array([[6.5, 3.5]], np.float32), mask, score)
    imagination = Imagination("a hand", Image.new("RGB", (8, 8), "red"))
    return Affordance("open", (30, 20), imagination, Target("open", "box", "the lid"), (region,))


def pixels(png: str) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(png))))


def test_the_default_form_is_what_the_library_reads() -> None:
    read = Affordance.from_dict(json.loads(wire.dumps(wire.to_wire(affordance()))))
    assert (read.mask == affordance().mask).all()
    assert read.target == affordance().target


def test_the_documented_schema_fits_every_form() -> None:
    for mask in ("rle", "png", "none"):
        for imagination in ("none", "png"):
            wire.AffordanceOut.model_validate(wire.to_wire(affordance(), mask, imagination))
    wire.AffordanceOut.model_validate(wire.to_wire(Affordance("", (0, 0), status="error", error="why"), "png"))


def test_png_masks_and_pictures_are_the_same_pixels() -> None:
    data = wire.to_wire(affordance(), "png", "png")
    assert ((pixels(data["mask"]["png"]) == 255) == affordance().mask).all()
    assert (pixels(data["imagination"]["png"]) == (255, 0, 0)).all()
    assert wire.imagination_to_wire(Imagination("Edit it.", Image.new("CMYK", (4, 4))), "png")["png"]


@pytest.mark.parametrize("score", [float("nan"), float("inf"), -float("inf")])
def test_numbers_that_json_does_not_know_are_null(score: float) -> None:
    assert wire.to_wire(affordance(score))["regions"][0]["score"] is None
    found = Detection(np.zeros((1, 4), np.float32), scores=np.array([score], np.float32))
    assert wire.stage_to_wire("detection", found, "none")["scores"] == [None]
    with pytest.raises(ValueError, match="JSON"):
        wire.dumps({"score": score})


def test_an_event_is_one_line_of_data_whatever_the_words() -> None:
    target = Target("a\nb", "ü", "x\r\n\r\nevent: affordance\ndata: {}", "日本")
    event = wire.event("target", wire.stage_to_wire("target", target, "none"))
    assert event.count(b"\n") == 3
    assert b"\r" not in event
    name, data = event.decode().strip().split("\n")
    assert name == "event: target"
    assert json.loads(data.removeprefix("data: "))["object_part"] == target.object_part


def test_a_detection_without_scores_says_so() -> None:
    found = wire.stage_to_wire("detection", Detection(), "none")
    assert found == {"boxes_xyxy": [], "points_xy": [], "scores": None}
