"""The exact outline of an object in its window, from a network's rough certainty and the colours around it.

outline(window (h, w, 3), certainty (h, w), prior (h, w), by_colour) -> mask (h, w), odd (h, w)
"""

from __future__ import annotations

import numpy as np

from a4agent.errors import require
from a4agent.offline import growth
from a4agent.offline.boxes import box_around
from a4agent.offline.colour import SAME, palette, to_lab, unlike


def outline(
    window: np.ndarray, certainty: np.ndarray, prior: np.ndarray, by_colour: bool
) -> tuple[np.ndarray, np.ndarray]:
    """The object's mask (h, w) from what the network says and what does not look like the local background.

    `prior` (h, w) bool is where the object was found; `by_colour`: pixel by pixel. Also returned: all that
    does not look like the background, (h, w) bool.
    """
    cv2 = require("cv2", extra="offline")
    square = np.ones((3, 3), np.uint8)
    sure = certainty > 0.5
    if not (sure | prior).any():
        return prior, np.zeros_like(prior)
    lab = to_lab(window, blur=0.8)
    reach = int(0.4 * np.sqrt(max(sure.sum(), prior.sum())))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    around = cv2.dilate((sure | prior).astype(np.uint8), disc) > 0
    background = around & (certainty < 0.15) & (cv2.dilate(prior.astype(np.uint8), square, iterations=5) == 0)
    colours = _reaching_the_border(palette(lab[background]), lab)
    if not colours:
        return _main_pieces(sure if sure.any() else prior, sure | prior), np.zeros_like(prior)
    distance = unlike(lab, colours)
    noise = 1.8 * float(np.percentile(distance[background], 85))
    enough = float(np.clip(noise, 6.0, 14.0))
    if by_colour:
        # Where the network fills what colour leaves open, it is the hole of a handle.
        beside = cv2.dilate(prior.astype(np.uint8), square, iterations=3) > 0
        sure &= prior | ~beside | (distance > enough)
    core = sure | (prior & (distance > enough))
    odd = distance > 1.2 * enough
    if not core.any():
        return prior, odd
    object_ = growth.attached(core, odd)
    object_ = growth.aligned(object_, distance > min(max(noise, 4.0), 0.8 * enough))

    labels = np.where(object_, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    certain = ((certainty > 0.9) | (object_ & ~core)) & (distance > enough)
    labels[cv2.erode(certain.astype(np.uint8), square, iterations=1) > 0] = cv2.GC_FGD
    seen_twice = ((certainty > 0.97) & prior).astype(np.uint8)
    labels[cv2.erode(seen_twice, square, iterations=2) > 0] = cv2.GC_FGD
    outside = cv2.dilate(object_.astype(np.uint8), square, iterations=8) == 0
    labels[outside] = cv2.GC_BGD
    labels[(distance < 0.6 * enough) & (certainty < 0.95)] = cv2.GC_PR_BGD
    labels[(distance < 0.6 * enough) & (certainty < 0.6)] = cv2.GC_BGD
    drawn = _grab_cut(window, labels, ~outside, object_)
    if by_colour:
        seen = prior | (object_ & ~sure)
        drawn &= cv2.dilate(seen.astype(np.uint8), square, iterations=2) > 0
        drawn |= sure & cv2.erode(prior.astype(np.uint8), square) > 0
    return _main_pieces(drawn if drawn.any() else object_, object_), odd


def _reaching_the_border(colours: list[np.ndarray], lab: np.ndarray) -> list[np.ndarray]:
    """The first background colour and those of the others that the window's border shows: a blade is none."""
    sides = (lab[:2], lab[-2:], lab[:, :2], lab[:, -2:])
    border = np.concatenate([side.reshape(-1, 3) for side in sides])
    shares = [(np.linalg.norm(border - colour, axis=1) < SAME).mean() for colour in colours]
    return [colour for index, colour in enumerate(colours) if index == 0 or shares[index] > 0.08]


def _grab_cut(window: np.ndarray, labels: np.ndarray, region: np.ndarray, start: np.ndarray) -> np.ndarray:
    """`start` with its outline drawn to the edges of the picture (Rother et al., SIGGRAPH 2004), inside `region`."""
    cv2 = require("cv2", extra="offline")
    x0, y0, x1, y1 = box_around(region, 0.05)
    part = np.ascontiguousarray(labels[y0:y1, x0:x1])
    if (part == cv2.GC_BGD).sum() < 50 or (start[y0:y1, x0:x1]).sum() < 20:
        return start
    cv2.setRNGSeed(0)
    smooth = np.ascontiguousarray(cv2.GaussianBlur(window, (0, 0), 0.8)[y0:y1, x0:x1])
    cv2.grabCut(smooth, part, None, np.zeros((1, 65)), np.zeros((1, 65)), 3, cv2.GC_INIT_WITH_MASK)
    drawn = np.zeros_like(start)
    drawn[y0:y1, x0:x1] = (part == cv2.GC_FGD) | (part == cv2.GC_PR_FGD)
    return drawn if drawn.sum() > 0.4 * start.sum() else start


def _main_pieces(mask: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The pieces of `mask` that hold most of `wanted`."""
    cv2 = require("cv2", extra="offline")
    _, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    held = np.bincount(labels.ravel(), weights=wanted.ravel().astype(np.float64))
    held[0] = 0
    if held.max() == 0:
        return mask
    return np.isin(labels, np.flatnonzero((held > 0.1 * held.max()) & (held > 0)))
