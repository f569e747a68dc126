"""Things in a picture: found, told apart by colour, side and size, with key points that lie in them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from a4agent.offline import create
from a4agent.offline.colour import name_of
from a4agent.offline.eye import look
from a4agent.offline.training.drawings import draw
from a4agent.offline.vocabulary import GRIP, PARTS, WORK
from a4agent.protocols import DetectRequest, Prompt, Segmentation, SegmentRequest
from a4agent.types import Detection


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


PHRASES = [
    "the handle of the mug",
    "the inside of the mug",
    "the blade of the knife",
    "the rim of the cup",
    "the drawer",
]


def pictures() -> list[Image.Image]:
    """Random drawings of all kinds, noise, and noise with a bright patch."""
    drawn = [Image.fromarray(draw(np.random.default_rng([77, k])).image) for k in range(10)]
    rng = np.random.default_rng(5)
    noise = rng.integers(0, 256, (90, 160, 3), np.uint8).astype(np.uint8)
    patched = (noise // 4).astype(np.uint8)
    patched[30:60, 50:120] += 150
    return [*drawn, Image.fromarray(noise), Image.fromarray(patched)]


def test_a_key_point_lies_in_its_mask_and_its_thing(two_mugs: Image.Image) -> None:
    for picture in (two_mugs, *pictures()):
        for phrase in PHRASES:
            found = create("parts", "detector").detect([DetectRequest(picture, phrase)])[0]
            assert isinstance(found, Detection)
            if not len(found.points_xy):
                assert not any(thing.mask.any() for thing in look(picture))
                continue
            prompt = Prompt(found.boxes_xyxy[0], found.points_xy)
            answer = create("parts", "segmenter").segment([SegmentRequest(picture, (prompt,))])[0]
            assert isinstance(answer, Segmentation)
            x, y = np.floor(found.points_xy[0]).astype(int)
            assert answer.masks[0, 0][y, x]
            assert any(thing.mask[y, x] for thing in look(picture))


def test_a_long_thing_is_cut_straight_where_the_maps_change(screwdriver: Callable) -> None:
    """Exchanged maps exchange the ends, and a stray patch of the other label does not fray the cut."""
    (thing, *_) = look(screwdriver().image)
    grip = thing.part("grip", kind="screwdriver")
    exchanged = thing.maps.copy()
    exchanged[[GRIP, WORK]] = exchanged[[WORK, GRIP]]
    assert (replace(thing, maps=exchanged).part("work", kind="screwdriver") == grip).mean() > 0.99
    y, x = np.argwhere(grip).mean(0).astype(int)
    frayed = thing.maps.copy()
    frayed[[GRIP, WORK], y - 2 : y + 2, x - 2 : x + 2] = [[[0.05]], [[0.9]]]
    assert (replace(thing, maps=frayed).part("grip", kind="screwdriver") == grip).mean() > 0.99


def test_a_thing_has_only_the_parts_of_its_kind(screwdriver: Callable) -> None:
    (thing, *_) = look(screwdriver().image)
    assert not thing.part("body", "inside", "lid", kind="knife").any()
    assert not thing.part("work", kind="mug").any()
    assert (thing.part(*PARTS[1:], kind="mug") == thing.shown).all()


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
