"""Things in a picture: found, told apart by colour, side and size, with key points that lie in them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from a4agent.offline import create
from a4agent.offline.choice import choose
from a4agent.offline.colour import name_of
from a4agent.offline.eye import look
from a4agent.offline.phrases import wanted
from a4agent.offline.vocabulary import GRIP, WORK
from a4agent.protocols import DetectRequest, Prompt, SegmentRequest


@pytest.fixture(scope="module")
def two_mugs(mug: Callable) -> Image.Image:
    """A white mug on the left, and the same in red on the right."""
    left = np.asarray(mug(table=(60, 70, 60)).image.resize((320, 240)))
    right = left.copy()
    white = left.min(2) > 120
    right[white] = right[white] * np.array([0.8, 0.15, 0.15])
    return Image.fromarray(np.hstack([left, right]))


def point_of(image: Image.Image, phrase: str) -> np.ndarray:
    return create("parts", "detector").detect([DetectRequest(image, phrase)])[0].points_xy[0]  # type: ignore[union-attr]


def test_two_things_are_two_candidates(two_mugs: Image.Image) -> None:
    middles = [(thing.box_xyxy[0] + thing.box_xyxy[2]) / 2 for thing in look(two_mugs)]
    assert any(x < 320 for x in middles)
    assert any(x > 320 for x in middles)


@pytest.mark.parametrize(
    ("phrase", "right"),
    [("the red mug", True), ("the white mug", False), ("the mug on the left", False), ("the right mug", True)],
)
def test_colour_and_side_tell_things_apart(two_mugs: Image.Image, phrase: str, right: bool) -> None:
    assert (point_of(two_mugs, phrase)[0] > 320) == right


@pytest.mark.parametrize("phrase", ["the handle of the mug", "the inside of the mug", "the handle of the drawer"])
def test_a_key_point_lies_in_its_mask(two_mugs: Image.Image, phrase: str) -> None:
    found = create("parts", "detector").detect([DetectRequest(two_mugs, phrase)])[0]
    prompt = Prompt(found.boxes_xyxy[0], found.points_xy)  # type: ignore[union-attr]
    mask = create("parts", "segmenter").segment([SegmentRequest(two_mugs, (prompt,))])[0].masks[0, 0]
    x, y = np.floor(found.points_xy[0]).astype(int)  # type: ignore[union-attr]
    assert mask[y, x]


def test_the_network_says_which_end_is_the_grip(screwdriver: Callable) -> None:
    """Rules cut the tool; maps with both ends exchanged exchange their answers."""
    (thing, *_) = look(screwdriver().image)
    assert thing.silhouette is not None
    maps = thing.maps.copy()
    maps[[GRIP, WORK]] = 0.1
    (grip, shaft) = (choose(wanted(f"the {part} of the screwdriver"), [thing]) for part in ("handle", "shaft"))
    assert grip is not None
    assert shaft is not None
    for part, mask in ((GRIP, shaft.mask), (WORK, grip.mask)):
        maps[part][thing.in_window(mask)] = 0.9
    exchanged = [replace(thing, maps=maps)]
    assert (choose(wanted("the handle of the screwdriver"), exchanged).mask == shaft.mask).all()  # type: ignore[union-attr]
    assert (choose(wanted("the shaft of the screwdriver"), exchanged).mask == grip.mask).all()  # type: ignore[union-attr]


def test_kinds_sum_to_one(two_mugs: Image.Image) -> None:
    for thing in look(two_mugs):
        assert sum(thing.kinds.values()) == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize(
    ("rgb", "name"),
    [((200, 20, 20), "red"), ((20, 40, 200), "blue"), ((15, 15, 15), "black"), ((240, 240, 240), "white"),
     ((30, 150, 40), "green"), ((240, 220, 30), "yellow"), ((110, 60, 30), "brown"), ((128, 128, 128), "grey")],
)  # fmt: skip
def test_plain_names_of_colours(rgb: tuple[int, int, int], name: str) -> None:
    assert name_of(np.array([rgb] * 5, np.uint8)) == name
