"""Which thing in a picture a phrase means, and which region of it.

choose(wanted("the handle of the black mug"), look(image)) -> Choice(thing=<the black mug>, region=<its handle>)
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from a4agent.errors import require
from a4agent.offline.phrases import Wanted
from a4agent.offline.seen_object import LEAST_PART, SeenObject
from a4agent.offline.vocabulary import KINDS, PARTS, PARTS_OF

ALIKE: tuple[frozenset[str], ...] = (
    frozenset({"knife", "saw"}),
    frozenset({"spoon", "shovel", "trowel", "turner", "fork", "brush"}),
    frozenset({"mug", "cup", "kettle", "bottle"}),
    frozenset({"bowl", "pan", "cup"}),
    frozenset({"drawer", "door", "cabinet", "microwave", "coffee machine", "box"}),
    frozenset({"switch", "knob", "lever", "faucet"}),
    frozenset({"pliers", "scissors", "wrench"}),
    frozenset({"hammer", "wrench"}),
)
"""Kinds that the network takes for each other."""
STAND_INS = {
    "grip": ("grip", "control"), "work": ("work", "control", "lid", "spout"), "body": ("body", "inside"),
    "inside": ("inside", "work"), "control": ("control", "grip"), "lid": ("lid", "inside", "spout"),
    "spout": ("spout", "lid"),
}  # fmt: skip
"""What to look for when a thing has no such part: the first that it has."""
UNNAMED = frozenset({"none", "other"})
"""Kinds that are no name for a thing."""
PLACES = ("rim", "bottom", "top")
"""Shapes that are places on a body."""
RIM = 5
"""Pixels of the window that a rim is wide."""
SPECK = 0.15
"""A piece of a part is left out if it is smaller than this share of the largest piece."""
NEAR_COLOURS = {
    "silver": ("grey", "white"), "gold": ("yellow", "brown", "orange"), "beige": ("brown", "white", "yellow"),
    "grey": ("white", "black"), "brown": ("orange", "beige", "red"), "orange": ("brown", "red", "yellow"),
    "pink": ("red", "purple"), "purple": ("pink", "blue"), "white": ("grey", "beige"), "black": ("grey",),
    "red": ("orange", "pink", "brown"), "yellow": ("orange", "beige"), "transparent": ("white", "grey"),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Choice:
    """A thing, the `region` (SIDE, SIDE) bool of its window, and how likely the thing is of the named kind, 0..1.

    `match` is None where no kind was named that the network knows.
    """

    thing: SeenObject
    region: np.ndarray
    match: float | None


def choose(wanted: Wanted, things: Sequence[SeenObject]) -> Choice | None:
    """What a phrase means among the things of a picture; None where there is none."""
    if not things:
        return None
    scores = [_fit(wanted, thing) for thing in things]
    if wanted.side or wanted.size or wanted.colour:
        scores = _told_apart(wanted, things, scores)
    best = things[int(np.argmax(scores))]
    region = _region(wanted, best)
    return Choice(best, region if best.region(region).any() else best.shown, match(wanted, best))


def match(wanted: Wanted, thing: SeenObject) -> float | None:
    """How likely a thing is of the named kind; None if the network knows no such kind."""
    return thing.kinds[wanted.kind] if wanted.kind in KINDS and wanted.kind not in UNNAMED else None


def regions(thing: SeenObject) -> Collection[np.ndarray]:
    """Every region (SIDE, SIDE) bool of a thing's window that some phrase could mean; `thing.region` places it."""
    found = {thing.shown.tobytes(): thing.shown}
    for kind in (None, *{PARTS_OF[kind]: kind for kind in KINDS}.values()):
        for names in (*((name,) for name in PARTS[1:]), ("body", "inside"), ("inside", "work")):
            region = thing.part(*names, kind=kind)
            if region.sum() >= LEAST_PART:
                found |= {piece.tobytes(): piece for piece in (region, *_pieces(region))}
        for part, shape in (("work", "tip"), *(("body", place) for place in PLACES)):
            region = _region(Wanted(shape, part=part, kind=kind), thing)
            found[region.tobytes()] = region
    return found.values()


def _fit(wanted: Wanted, thing: SeenObject) -> float:
    """How well a thing fits a phrase, whatever its colour, side and size."""
    score = thing.objectness * (0.6 + 0.4 * np.clip(thing.contrast, 0, 1))
    if wanted.kind in KINDS:
        family = frozenset().union(*(group for group in ALIKE if wanted.kind in group))
        near = sum(thing.kinds[kind] for kind in family if kind != wanted.kind)
        score *= 0.05 + thing.kinds[wanted.kind] + 0.4 * near
    if wanted.part != "whole":
        score *= 0.3 + 0.7 * min(1.0, thing.part(wanted.part, kind=wanted.kind).sum() / 60)
    return float(score)


def _told_apart(wanted: Wanted, things: Sequence[SeenObject], scores: list[float]) -> list[float]:
    """The scores times how well each thing's colour, side and size fit, among those that fit otherwise."""
    best = max(scores)
    rivals = [k for k, score in enumerate(scores) if score > 0.2 * best]
    centres = np.array([(things[k].box_xyxy[:2] + things[k].box_xyxy[2:]) / 2 for k in rivals])
    extents = np.array([(things[k].box_xyxy[2:] - things[k].box_xyxy[:2]).max() for k in rivals])
    new = [0.01 * score for score in scores]
    for index, k in enumerate(rivals):
        factor = 1.0
        if wanted.colour:
            near = NEAR_COLOURS.get(wanted.colour, ())
            factor *= 1.0 if things[k].colour == wanted.colour else 0.3 if things[k].colour in near else 0.05
        if wanted.side:
            factor *= 0.02 + _share(_along(wanted.side, centres), index)
        if wanted.size:
            factor *= 0.02 + _share(extents if wanted.size in ("large", "long") else -extents, index)
        new[k] = scores[k] ** 0.5 * factor
    return new


def _along(side: str, centres: np.ndarray) -> np.ndarray:
    """How far each centre (n, 2) lies towards a side."""
    x, y = centres.T
    middle = -np.abs(x - x.mean())
    return {"left": -x, "right": x, "upper": -y, "lower": y, "front": y, "back": -y, "middle": middle}[side]


def _share(values: np.ndarray, index: int) -> float:
    """0 for the least of values (n,), 1 for the greatest."""
    spread = float(np.ptp(values))
    return 1.0 if spread == 0 else float((values[index] - values.min()) / spread) ** 2


def _region(wanted: Wanted, thing: SeenObject) -> np.ndarray:
    """The part that is wanted by the network's maps, (SIDE, SIDE) bool in the thing's window."""
    if wanted.part == "whole":
        return thing.shown
    for name in STAND_INS[wanted.part]:
        region = thing.part(name, kind=wanted.kind)
        if region.sum() >= LEAST_PART:
            return _finer(wanted, thing, np.any(_pieces(region), 0))
    likely = thing.maps[PARTS.index(wanted.part)] * thing.shown
    faint = likely > 0.5 * max(float(likely.max()), 1e-6)
    return faint if likely.max() > 0.15 and faint.sum() >= LEAST_PART else thing.shown


def _finer(wanted: Wanted, thing: SeenObject, region: np.ndarray) -> np.ndarray:
    """The piece of a region on the side, of the colour or of the shape that was named."""
    pieces = _pieces(region)
    side = wanted.part_side
    if side and len(pieces) > 1:
        centres = np.array([np.argwhere(piece).mean(0)[::-1] for piece in pieces])
        return pieces[int(np.argmax(_along(side, centres)))]
    if wanted.shape == "tip" and (grip := thing.part("grip", kind=wanted.kind)).any():
        return _end(region, grip)
    if wanted.shape in PLACES and wanted.part == "body":
        return _place(wanted.shape, region, thing.part("inside", kind=wanted.kind))
    return region


def _place(shape: str, body: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """The rim, bottom or top of a body (h, w) bool with an `inside` (h, w) bool, which may be blank."""
    cv2 = require("cv2", extra="offline")
    if shape == "rim" and inside.any():
        ring = np.ones((RIM, RIM), np.uint8)
        near = cv2.dilate(inside.astype(np.uint8), ring) - cv2.erode(inside.astype(np.uint8), ring)
        return (near > 0) & (body | inside)
    rows = np.flatnonzero(body.any(1))
    below = np.arange(len(body))[:, None] >= rows[0] + (rows[-1] - rows[0]) * (0.8 if shape == "bottom" else 0.2)
    return body & (below if shape == "bottom" else ~below)


def _end(region: np.ndarray, grip: np.ndarray) -> np.ndarray:
    """The third of a region that is farthest from the grip."""
    away = np.argwhere(region) - np.argwhere(grip).mean(0)
    distance = np.hypot(*away.T)
    far = np.zeros_like(region)
    far[tuple(np.argwhere(region)[distance >= distance.min() + 0.75 * np.ptp(distance)].T)] = True
    return far


def _pieces(region: np.ndarray) -> list[np.ndarray]:
    """The connected pieces of a region, the largest first, without specks."""
    cv2 = require("cv2", extra="offline")
    count, labels, stats, _ = cv2.connectedComponentsWithStats(region.astype(np.uint8))
    sizes = stats[1:, cv2.CC_STAT_AREA]
    order = 1 + np.argsort(-sizes)
    return [labels == k for k in order if stats[k, cv2.CC_STAT_AREA] >= SPECK * sizes.max()] if count > 1 else []
