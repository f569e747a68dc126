"""A thing that the network saw, and its parts.

thing.box_xyxy                       # (4,) float32 pixels
thing.kinds["mug"]                   # 0..1; all kinds sum to 1, "none" among them
thing.colour                         # "red"
thing.mask, thing.part("grip")       # (H, W) bool of the picture, (SIDE, SIDE) bool of the window
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from a4agent.errors import require
from a4agent.imaging.masks import tight_box
from a4agent.offline.vocabulary import GRIP, NOTHING, PARTS, PARTS_OF, WORK

SIDE = 160
"""Pixels of a window that is looked at closely."""
ENDS_ONLY = 0.7
"""A thing of which grip and working end take this share, and which is long, is cut straight across where they meet."""
LONG = 3.0
"""How many times more a thing's pixels vary along its longer axis than across it."""
LEAST_PART = 16
"""Pixels of a thing's window, of 160 x 160, that a part takes."""
SHOWN = 0.5
"""A pixel belongs to a thing if "nothing" is less likely than this."""


@dataclass(frozen=True, eq=False)
class SeenObject:
    """One thing: its box, kinds, colour, and part maps (8, SIDE, SIDE) of probabilities in a square `window`.

    `window` is centre x, centre y and side in pixels of the picture of `size_wh`; `objectness` says how sure it
    is that this is one whole thing, `contrast` how much more it stands out than what is around it. `looked_at`
    (h, w, 3) uint8 is the picture as it was looked at: not too large, and well lit.
    """

    box_xyxy: np.ndarray
    kinds: Mapping[str, float]
    colour: str
    maps: np.ndarray
    window: np.ndarray
    size_wh: tuple[int, int]
    objectness: float
    contrast: float
    looked_at: np.ndarray

    @property
    def likeliest(self) -> tuple[str, float]:
        """The kind that the network takes it for, and how likely it is."""
        return max(self.kinds.items(), key=lambda item: item[1])

    @cached_property
    def shown(self) -> np.ndarray:
        """The thing in its window, (SIDE, SIDE) bool: its largest connected piece and pieces close to it."""
        return main_piece(1 - self.maps[NOTHING] > SHOWN)

    @cached_property
    def mask(self) -> np.ndarray:
        """The thing in the picture, (H, W) bool."""
        return self.to_image((1 - self.maps[NOTHING]) * self.shown_softly)

    def part(self, *names: str, kind: str | None = None) -> np.ndarray:
        """The parts with these names in the window, (SIDE, SIDE) bool: where one of them is the likeliest part.

        Only parts that things of its kind have come into question: of `kind` if the network knows it, else of the kinds
        that it takes the thing for.
        """
        labels = self.labels(PARTS_OF.get(kind or ""))
        return np.isin(labels, [PARTS.index(name) for name in names])

    def labels(self, possible: tuple[str, ...] | None = None) -> np.ndarray:
        """The likeliest part of each pixel of the window, (SIDE, SIDE) indices of PARTS."""
        if possible not in self._labels:
            likely = [(PARTS_OF[kind], p) for kind, p in self.kinds.items()] if possible is None else [(possible, 1.0)]
            weights = [sum(p for parts, p in likely if name in parts) for name in PARTS[1:]]
            maps = self.maps[1:] * np.array(weights, np.float32)[:, None, None]
            ends = _cut_across(maps, self.shown)
            self._labels[possible] = (1 + maps.argmax(0)) * self.shown if ends is None else ends
        return self._labels[possible]

    @cached_property
    def closer(self) -> dict[bytes, SeenObject]:
        """The thing as it was seen from near its regions (`eye.look_closer`), by their bytes."""
        return {}

    @cached_property
    def _labels(self) -> dict[tuple[str, ...] | None, np.ndarray]:
        return {}

    @cached_property
    def shown_softly(self) -> np.ndarray:
        """`shown` with a margin of two pixels, (SIDE, SIDE) float32."""
        cv2 = require("cv2", extra="offline")
        return cv2.dilate(self.shown.astype(np.float32), np.ones((5, 5), np.uint8))

    def region(self, region: np.ndarray) -> np.ndarray:
        """A region (SIDE, SIDE) bool of the window, in the picture, (H, W) bool."""
        cv2 = require("cv2", extra="offline")
        return self.to_image(cv2.GaussianBlur(region.astype(np.float32), (0, 0), 1.1))

    def box_of(self, region: np.ndarray) -> np.ndarray:
        """The box (4,) in the picture around a region (SIDE, SIDE) bool, not blank, of the window."""
        tight = tight_box(region)
        assert tight is not None
        return box_in_picture(tight, self.window, SIDE)

    def to_image(self, likely: np.ndarray) -> np.ndarray:
        """A map (SIDE, SIDE) of probabilities of the window as a mask (H, W) bool of the picture."""
        cv2 = require("cv2", extra="offline")
        width, height = self.size_wh
        x, y, side = (float(value) for value in self.window)
        scale = SIDE / side
        matrix = np.array(
            [[scale, 0, (0.5 - x + side / 2) * scale - 0.5], [0, scale, (0.5 - y + side / 2) * scale - 0.5]]
        )
        soft = cv2.warpAffine(
            likely.astype(np.float32), matrix, (width, height), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        )
        return soft > SHOWN


def box_in_picture(box_xyxy: np.ndarray, window: np.ndarray, side: int) -> np.ndarray:
    """A box (4,) of a window's crop of `side` pixels in pixels of the picture."""
    return np.tile(window[:2] - window[2] / 2, 2) + box_xyxy.astype(np.float64) * window[2] / side


def _cut_across(maps: np.ndarray, shown: np.ndarray) -> np.ndarray | None:
    """Labels (h, w) of a long thing's two ends, GRIP and WORK, with a straight cut between them; None of other things.

    `maps` (7, h, w) are the probabilities of the parts, `shown` (h, w) is the thing.
    """
    grip, work = maps[GRIP - 1], maps[WORK - 1]
    points = np.argwhere(shown).astype(np.float64)
    if len(points) < LEAST_PART or (grip + work)[shown].sum() < ENDS_ONLY * maps[:, shown].sum():
        return None
    variances, axes = np.linalg.eigh(np.cov((points - points.mean(0)).T))
    if variances[1] < LONG * variances[0]:
        return None
    order = np.argsort(points @ axes[:, 1])
    evidence = (np.log(grip[shown] + 0.05) - np.log(work[shown] + 0.05))[order]
    before = np.concatenate([[0.0], np.cumsum(evidence)])
    agreement = 2 * before - before[-1]  # with a cut after each pixel: before it grip, after it work
    cut = int(np.abs(agreement).argmax())
    first, second = (GRIP, WORK) if agreement[cut] > 0 else (WORK, GRIP)
    labels = np.zeros(shown.shape, np.int64)
    labels[tuple(points[order[:cut]].astype(int).T)] = first
    labels[tuple(points[order[cut:]].astype(int).T)] = second
    return labels


def main_piece(mask: np.ndarray) -> np.ndarray:
    """The largest connected piece of a mask (h, w) bool, with pieces within three pixels of it."""
    cv2 = require("cv2", extra="offline")
    near = cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8))
    _, labels = cv2.connectedComponents(near)
    sizes = np.bincount(labels[mask], minlength=2)
    sizes[0] = 0
    return mask & (labels == sizes.argmax()) if sizes.max() else mask
