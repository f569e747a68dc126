"""Handles on larger things: the bar is told from frames and shading, also where it is all that stood out."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from a4agent.offline.colour import to_lab
from a4agent.offline.details import BAR, details, longest, slimness
from a4agent.offline.parts import Anatomy
from a4agent.offline.phrases import wanted
from a4agent.offline.silhouette import Silhouette

SHAPE = 200, 160
WOOD, WHITE, EDGE = (90, 60, 40), (240, 240, 240), (150, 110, 80)


def stroke(*points: tuple[int, int], thickness: int = 9) -> np.ndarray:
    line = np.array(points, np.int32)
    return cv2.polylines(np.zeros(SHAPE, np.uint8), [line], False, 1, thickness) > 0


DOOR = stroke((80, 40), (80, 160), thickness=91)
STRAIGHT = stroke((50, 80), (50, 130))
BENT = stroke((60, 90), (60, 112), (102, 112), (102, 90))
FRAME = stroke((40, 25), (40, 175), thickness=11)
SHADING = stroke((55, 60), (105, 60), thickness=5)


def door(*layers: tuple[np.ndarray, tuple[int, int, int]]) -> tuple[np.ndarray, np.ndarray]:
    rgb = np.full((*SHAPE, 3), 200, np.uint8)
    for mask, colour in ((DOOR, WOOD), *layers):
        rgb[mask] = colour
    return DOOR, to_lab(rgb, blur=0.8)


@pytest.mark.parametrize("bar", [STRAIGHT, BENT], ids=["straight", "bent"])
def test_the_handle_of_a_door(bar: np.ndarray, overlap) -> None:
    found = longest(list(details(*door((bar, WHITE)))))
    assert found is not None
    assert overlap(found, bar) > 0.7


@pytest.mark.parametrize(("other", "colour"), [(FRAME, WHITE), (SHADING, EDGE)], ids=["frame", "shading"])
def test_a_frame_or_an_edge_is_no_handle(other: np.ndarray, colour: tuple[int, int, int], overlap) -> None:
    found = longest(list(details(*door((other, colour), (BENT, WHITE)))))
    assert found is not None
    assert overlap(found, BENT) > 0.7


@pytest.mark.parametrize("bar", [STRAIGHT, BENT], ids=["straight", "bent"])
def test_a_handle_that_is_all_that_stood_out_is_the_handle(bar: np.ndarray) -> None:
    assert slimness(bar) > BAR > slimness(DOOR)
    lab = to_lab(np.where(bar[..., None], np.uint8(240), np.uint8(60)).repeat(3, 2))
    lab += np.random.default_rng(0).normal(0, 4, lab.shape).astype(np.float32)
    anatomy = Anatomy(Silhouette((0, 0, SHAPE[1], SHAPE[0]), bar, lab))
    assert (anatomy.find(wanted("the handle of the drawer")) == bar).all()


@pytest.mark.parametrize(
    "phrase",
    [
        "the handle of the drawer",
        "the handle of the upper drawer below the sink",
        "the handle of the drawer with a mug",
    ],
)
def test_of_things_and_their_places_the_thing_counts(phrase: str) -> None:
    assert wanted(phrase).shape == "bar"


def test_the_last_word_of_a_name_counts() -> None:
    assert wanted("the handle of the coffee mug") == wanted("the handle of the mug")
