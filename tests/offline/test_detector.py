"""The detector and the segmenter together find the part that a phrase names, on pictures drawn for the test."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from a4agent import A4Agent
from a4agent.errors import ConfigError, UnknownNameError
from a4agent.offline import create
from a4agent.protocols import Detector, DetectRequest, Prompt, SegmentRequest
from a4agent.types import Detection

PARTS = [
    ("screwdriver", "handle", "the handle of the screwdriver"),
    ("screwdriver", "shaft", "the shaft of the screwdriver"),
    ("screwdriver", "whole", "the screwdriver"),
    ("spoon", "handle", "the handle of the spoon"),
    ("spoon", "bowl", "the bowl of the spoon"),
    ("mug", "handle", "the handle of the mug"),
    ("mug", "body", "the body of the mug"),
    ("pan", "handle", "the handle of the pan"),
    ("pan", "pan", "the cooking surface of the pan"),
    ("pan", "handle", "the handle of the frobnicator"),
]


def detect(image: Image.Image, phrase: str) -> Detection:
    found = create("parts", "detector").detect([DetectRequest(image, phrase)])[0]
    assert isinstance(found, Detection)
    return found


@pytest.mark.parametrize("degrees", [10, 100])
@pytest.mark.parametrize(("name", "part", "phrase"), PARTS, ids=[phrase for *_, phrase in PARTS])
def test_the_part_is_found(name: str, part: str, phrase: str, degrees: float, request, overlap) -> None:
    drawing = request.getfixturevalue(name)(degrees=degrees)
    found = detect(drawing.image, phrase)
    assert found.boxes_xyxy.shape == (1, 4)
    assert found.boxes_xyxy.dtype == np.float32
    prompt = Prompt(found.boxes_xyxy[0], found.points_xy)
    answer = create("parts", "segmenter").segment([SegmentRequest(drawing.image, (prompt,))])[0]
    mask = answer.masks[0, 0]
    assert overlap(mask, drawing.parts[part]) > 0.7
    x, y = found.points_xy[0].astype(int)
    assert mask[y, x]
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    tight = [columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]
    assert np.abs(found.boxes_xyxy[0] - tight).max() <= 3


def test_the_inside_and_the_rim_of_a_mug(mug, overlap) -> None:
    drawing = mug()
    y, x = np.mgrid[:360, :480]
    inside = ((x - 220) / 70) ** 2 + ((y - 110) / 20) ** 2 <= 1
    masks = {}
    for name in ("inside", "rim"):
        found = detect(drawing.image, f"the {name} of the mug")
        prompt = Prompt(found.boxes_xyxy[0], found.points_xy)
        masks[name] = create("parts", "segmenter").segment([SegmentRequest(drawing.image, (prompt,))])[0].masks[0, 0]
    assert overlap(masks["inside"], inside) > 0.7
    assert 0 < masks["rim"].sum() < 0.7 * masks["inside"].sum()
    assert not masks["rim"][110, 220]


def test_the_whole_path_by_profile(screwdriver, overlap) -> None:
    drawing = screwdriver()
    with_agent = A4Agent.from_profile("offline").predict(drawing.image, "which part goes into the screw to tighten it?")
    assert with_agent.status == "ok"
    assert with_agent.target is not None
    assert with_agent.target.object_part == "the shaft of the screwdriver"
    assert overlap(with_agent.mask, drawing.parts["shaft"]) > 0.7


def test_what_the_reasoner_does_not_know_is_invalid(screwdriver) -> None:
    answer = A4Agent.from_profile("offline").predict(screwdriver().image, "translate this letter")
    assert answer.status == "invalid"
    assert not answer.mask.any()


@pytest.mark.parametrize("size", [(1, 1), (3, 200), (64, 64)])
def test_an_even_picture_has_no_part(size: tuple[int, int]) -> None:
    found = detect(Image.new("RGB", size, (90, 90, 90)), "the handle of the mug")
    assert found.boxes_xyxy.shape == (0, 4)
    assert found.points_xy.shape == (0, 2)


def test_a_folder_of_photographs_is_not_all_in_memory() -> None:
    with A4Agent.from_profile("offline") as agent:
        assert sum(expert.max_batch * expert.concurrency for expert in agent.experts()) <= 4


def test_the_answer_does_not_depend_on_the_name_of_an_unknown_object(pan) -> None:
    image = pan().image
    one, other = detect(image, "the handle of the frobnicator"), detect(image, "the handle of the zorble")
    assert (one.boxes_xyxy == other.boxes_xyxy).all()


def test_a_batch_keeps_its_order(pan, spoon) -> None:
    detector: Detector = create("parts", "detector")  # type: ignore[assignment]
    requests = [DetectRequest(pan().image, "the pan"), DetectRequest(spoon().image, "the spoon")]
    together = detector.detect(requests)
    alone = [detector.detect([request])[0] for request in requests]
    for a, b in zip(together, alone, strict=True):
        assert (a.boxes_xyxy == b.boxes_xyxy).all()


@pytest.mark.parametrize(
    ("model", "role", "error"),
    [("reasoner", "detector", ConfigError), ("parts", "vlm", ConfigError), ("part", "detector", UnknownNameError)],
)
def test_roles_that_do_not_fit(model: str, role: str, error: type[Exception]) -> None:
    with pytest.raises(error):
        create(model, role)  # type: ignore[arg-type]


def test_a_negative_number_of_threads() -> None:
    with pytest.raises(ConfigError, match="-1"):
        create("parts", "detector", threads=-1)
