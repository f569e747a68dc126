"""Which thing and which region of it a phrase means, on things made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from a4agent.offline import eye
from a4agent.offline.choice import choose, match, regions
from a4agent.offline.phrases import Wanted, wanted
from a4agent.offline.seen_object import SIDE, SeenObject
from a4agent.offline.vocabulary import BODY, GRIP, INSIDE, KINDS, NOTHING, PARTS

PICTURE = np.zeros((320, 640, 3), np.uint8)


def seen(x: float, kind: str = "mug", colour: str = "white", side: float = 160.0) -> SeenObject:
    """A vessel at column `x` of a picture of 640 x 320: inside above, body below, a handle on either side of it."""
    maps = np.full((len(PARTS), SIDE, SIDE), 0.01, np.float32)
    maps[NOTHING] = 0.93
    for part, rows, columns in (
        (BODY, slice(60, 130), slice(50, 110)),
        (INSIDE, slice(40, 60), slice(50, 110)),
        (GRIP, slice(70, 110), slice(110, 130)),
        (GRIP, slice(70, 110), slice(30, 50)),
    ):
        maps[:, rows, columns] = 0.01
        maps[part, rows, columns] = 0.93
    kinds = dict.fromkeys(KINDS, 0.1 / (len(KINDS) - 1)) | {kind: 0.9}
    half = side * 0.3
    box = np.array([x - half, 160 - half, x + half, 160 + half], np.float32)
    return SeenObject(box, kinds, colour, maps, np.array([x, 160.0, side]), (640, 320), 0.9, 0.5, PICTURE)


def test_what_lies_on_a_sheet_is_meant_before_the_sheet() -> None:
    sheet, hammer = seen(320, "microwave", side=500.0), seen(330, "hammer", side=120.0)
    assert eye._on_top([sheet, hammer])[0].kinds == hammer.kinds
    assert eye._on_top([sheet, hammer])[0].objectness > eye._on_top([sheet, hammer])[1].objectness
    for others in ([seen(330, "knob", side=120.0)], [seen(700, "hammer", side=120.0)], []):
        assert eye._on_top([sheet, *others])[0] is sheet
    mug = seen(320, "mug", side=500.0)
    assert eye._on_top([mug, hammer])[0] is mug


def chosen(phrase: str, *things: SeenObject) -> tuple[SeenObject, np.ndarray]:
    choice = choose(wanted(phrase), things)
    assert choice is not None
    return choice.thing, choice.thing.region(choice.region)


@pytest.mark.parametrize(
    ("phrase", "index"),
    [
        ("the handle of the pan", 1),
        ("the handle of the left mug", 0),
        ("the handle of the right mug", 2),
        ("the red mug", 2),
        ("the large mug", 0),
        ("the small mug", 2),
    ],
)
def test_the_thing_that_is_named(phrase: str, index: int) -> None:
    things = [seen(120, side=180.0), seen(320, "pan"), seen(520, colour="red", side=120.0)]
    assert chosen(phrase, *things)[0] is things[index]


def test_no_things_no_choice() -> None:
    assert choose(wanted("the mug"), []) is None


@pytest.mark.parametrize(
    ("phrase", "rows", "columns"),
    [
        ("the inside of the mug", (120, 140), (290, 350)),
        ("the body of the mug", (140, 210), (290, 350)),
        ("the handle of the mug", (150, 190), (270, 370)),
        ("the left handle of the mug", (150, 190), (270, 290)),
        ("the mug", (120, 210), (270, 370)),
    ],
)
def test_the_region_that_is_named(phrase: str, rows: tuple[int, int], columns: tuple[int, int]) -> None:
    """One pixel of the window is one of the picture here, 80 rows lower and 240 columns further to the right."""
    _, mask = chosen(phrase, seen(320))
    shown_rows, shown_columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    assert np.abs(np.subtract((shown_rows[0], shown_rows[-1] + 1), rows)).max() <= 2
    assert np.abs(np.subtract((shown_columns[0], shown_columns[-1] + 1), columns)).max() <= 2


def test_every_choice_is_among_the_regions() -> None:
    """The segmenter finds by its box what the detector chose."""
    thing = seen(320)
    offered = {thing.region(region).tobytes() for region in regions(thing)}
    for phrase in (
        "the handle of the mug",
        "the inside of the mug",
        "the rim of the mug",
        "the bottom of the mug",
        "the mug",
    ):
        assert chosen(phrase, thing)[1].tobytes() in offered, phrase


def test_match_is_the_probability_of_the_named_kind() -> None:
    assert match(wanted("the mug"), seen(320)) == pytest.approx(0.9)
    assert match(wanted("the handle of the frobnicator"), seen(320)) is None
    assert match(Wanted("whole", kind="other"), seen(320)) is None
