"""Things in a picture: found, told apart by colour, side and size, with key points that lie in them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from PIL import Image

from a4agent.offline import create, eye
from a4agent.offline.eye import look
from a4agent.offline.seen_object import SIDE, SeenObject
from a4agent.offline.training.drawings import draw
from a4agent.offline.vocabulary import BODY, GRIP, KINDS, PARTS
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


def test_kinds_sum_to_one(two_mugs: Image.Image) -> None:
    for thing in look(two_mugs):
        assert sum(thing.kinds.values()) == pytest.approx(1, abs=1e-3)


def small_handle(kind: str) -> tuple[SeenObject, np.ndarray]:
    """A thing of 160 pixels in the middle of a picture, and its handle's region, 24 by 6 pixels of the window."""
    region = np.zeros((SIDE, SIDE), bool)
    region[77:83, 68:92] = True
    maps = np.full((len(PARTS), SIDE, SIDE), 0.01, np.float32)
    maps[BODY] = 0.93
    maps[:, region] = 0.01
    maps[GRIP, region] = 0.93
    kinds = dict.fromkeys(KINDS, 0.1 / (len(KINDS) - 1)) | {kind: 0.9}
    box = np.array([80.0, 80, 240, 240], np.float32)
    picture = np.random.default_rng(0).integers(0, 256, (320, 320, 3), np.uint8)
    return SeenObject(box, kinds, "red", maps, np.array([160.0, 160, 160]), (320, 320), 0.9, 0.5, picture), region


@pytest.mark.parametrize(
    ("kind", "rows", "columns", "looks"),
    [
        ("drawer", (60, 100), (45, 115), True),  # as large as before
        ("drawer", (0, 160), (0, 160), False),  # all of the nearby window: not the same region
        ("drawer", (0, 40), (45, 115), False),  # beside the region
        ("mug", (60, 100), (45, 115), False),  # a vessel's part is large enough from afar
    ],
)
def test_a_small_region_is_looked_at_from_nearby(
    monkeypatch: pytest.MonkeyPatch, kind: str, rows: tuple[int, int], columns: tuple[int, int], looks: bool
) -> None:
    """The nearby look counts where it shows the same part in about the same place and size."""
    thing, region = small_handle(kind)
    near = np.full((1, len(PARTS), SIDE, SIDE), 0.01, np.float32)
    near[0, GRIP, slice(*rows), slice(*columns)] = 0.93
    monkeypatch.setattr(eye, "_ask", lambda *_, **__: (near, np.zeros((1, len(KINDS)))))
    mask = eye.look_closer(thing, region)
    assert (mask != thing.region(region)).any() == looks
    if looks:
        assert mask.sum() == pytest.approx((40 * 70) * (24 * eye.CLOSE / SIDE) ** 2, rel=0.15)
