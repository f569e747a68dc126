"""Loops, handles and spouts come off the body."""

from __future__ import annotations

import cv2
import numpy as np

from a4agent.offline.protrusions import split


def disc(x: int, y: int, radius: int) -> np.ndarray:
    return cv2.circle(np.zeros((200, 300), np.uint8), (x, y), radius, 1, -1) > 0


def test_a_loop_has_a_hole() -> None:
    body = disc(110, 100, 60)
    loop = (disc(180, 100, 40) & ~disc(180, 100, 28)) & ~body
    found, pieces = split(body | loop)
    assert pieces[0].hole > 200
    assert (pieces[0].mask & loop).sum() / (pieces[0].mask | loop).sum() > 0.8
    assert (found & body).sum() / (found | body).sum() > 0.9


def test_a_pans_handle_is_long_and_has_none() -> None:
    body = disc(90, 100, 60)
    handle = np.zeros_like(body)
    handle[94:106, 145:260] = True
    _, pieces = split(body | handle)
    assert len(pieces) == 1
    assert pieces[0].hole == 0
    assert pieces[0].length > 5 * pieces[0].width
    assert (pieces[0].mask & handle & ~body).sum() / (handle & ~body).sum() > 0.9


def test_a_disc_has_no_parts() -> None:
    assert split(disc(150, 100, 60))[1] == []


def test_specks_are_no_holes() -> None:
    body = disc(150, 100, 60)
    body[100, 150] = False
    assert split(body)[1] == []


def test_a_pixel_is_a_body() -> None:
    dot = np.zeros((9, 9), bool)
    dot[4, 4] = True
    body, pieces = split(dot)
    assert body.sum() == 1
    assert pieces == []
