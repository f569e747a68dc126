"""The segmenter alone: a person's boxes and points, on what the detector was never asked about."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from a4agent.offline import create
from a4agent.offline.eye import forget
from a4agent.protocols import DetectRequest, Prompt, Segmentation, SegmentRequest


def segment(image: Image.Image, *prompts: Prompt) -> Segmentation:
    answer = create("parts", "segmenter").segment([SegmentRequest(image, prompts)])[0]
    assert isinstance(answer, Segmentation)
    width, height = image.size
    assert answer.masks.shape == (len(prompts), 1, height, width)
    assert answer.masks.dtype == bool
    assert answer.predicted_iou.shape == (len(prompts), 1)
    return answer


def box_of(mask: np.ndarray, margin: int = 0) -> np.ndarray:
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    box = [columns[0] - margin, rows[0] - margin, columns[-1] + 1 + margin, rows[-1] + 1 + margin]
    return np.array(box, np.float32)


def points(*xy: tuple[float, float]) -> np.ndarray:
    return np.array(xy, np.float32).reshape(-1, 2)


@pytest.mark.parametrize(("name", "part"), [("screwdriver", "handle"), ("pan", "handle"), ("mug", "body")])
def test_a_loose_box_around_a_part(name: str, part: str, request, overlap) -> None:
    drawing = request.getfixturevalue(name)()
    answer = segment(drawing.image, Prompt(box_of(drawing.parts[part], margin=4)))
    assert overlap(answer.masks[0, 0], drawing.parts[part]) > 0.6


def test_what_the_detector_was_asked_before_changes_nothing(screwdriver) -> None:
    drawing = screwdriver()
    prompt = Prompt(box_of(drawing.parts["shaft"], margin=2))
    forget()
    before = segment(drawing.image, prompt)
    create("parts", "detector").detect([DetectRequest(drawing.image, "the handle of the hammer")])
    after = segment(drawing.image, prompt)
    assert (before.masks == after.masks).all()
    assert (before.predicted_iou == after.predicted_iou).all()


def test_several_prompts_in_one_request(screwdriver, overlap) -> None:
    drawing = screwdriver()
    names = ["shaft", "handle"]
    answer = segment(drawing.image, *(Prompt(box_of(drawing.parts[name])) for name in names))
    for index, name in enumerate(names):
        assert overlap(answer.masks[index, 0], drawing.parts[name]) > 0.7


def test_a_point_on_the_object_means_a_part_of_it(screwdriver) -> None:
    drawing = screwdriver()
    y, x = np.argwhere(drawing.parts["handle"]).mean(0)
    mask = segment(drawing.image, Prompt(None, points((x, y)))).masks[0, 0]
    assert mask[int(y), int(x)]
    assert (mask & drawing.parts["whole"]).sum() > 0.8 * mask.sum()


def test_a_point_on_the_table_means_the_table(screwdriver) -> None:
    drawing = screwdriver()
    mask = segment(drawing.image, Prompt(None, points((5, 5)))).masks[0, 0]
    assert mask[5, 5]
    assert not (mask & drawing.parts["handle"]).any()
    assert mask.mean() > 0.3


def test_a_box_away_from_the_main_object_looks_there(screwdriver, overlap) -> None:
    drawing = screwdriver()
    pixels = np.array(drawing.image)
    pixels[20:60, 20:70] = (20, 120, 40)
    other = np.zeros(pixels.shape[:2], bool)
    other[20:60, 20:70] = True
    mask = segment(Image.fromarray(pixels), Prompt(np.array([12, 12, 80, 70], np.float32))).masks[0, 0]
    assert overlap(mask, other) > 0.6


@pytest.mark.parametrize("size", [(1, 1), (5, 40), (50, 50)])
def test_boxes_on_even_pictures(size: tuple[int, int]) -> None:
    answer = segment(Image.new("RGB", size), Prompt(np.array([0, 0, *size], np.float32), points((0, 0))))
    assert answer.masks[0, 0].any()


def test_a_box_of_no_size_still_marks_a_pixel(screwdriver) -> None:
    answer = segment(screwdriver().image, Prompt(np.array([479.6, 359.7, 480, 360], np.float32)))
    assert answer.masks[0, 0].any()


def test_no_prompts_no_masks() -> None:
    segment(Image.new("RGB", (20, 10)))


def test_every_process_gives_the_same_answer(mug, tmp_path: Path) -> None:
    mug().image.save(tmp_path / "mug.png")
    code = (
        "import hashlib, sys; from a4agent import A4Agent\n"
        "with A4Agent.from_profile('offline') as agent:\n"
        "    answer = agent.predict(sys.argv[1], 'Lift the mug by its handle.')\n"
        "assert answer.mask.any()\n"
        "print(hashlib.sha256(answer.mask.tobytes() + answer.boxes_xyxy.tobytes() + answer.points_xy.tobytes())"
        ".hexdigest(), answer.target)"
    )
    said = {
        subprocess.run(
            [sys.executable, "-c", code, str(tmp_path / "mug.png")],
            capture_output=True, text=True, check=True, env={**os.environ, "PYTHONHASHSEED": seed},
        ).stdout
        for seed in ("1", "2")
    }  # fmt: skip
    assert len(said) == 1
