"""The things in a picture and their parts, by a network of 1.7 million parameters that this project trains.

    for thing in look(image):                # best first; the last pictures are remembered
        thing.box_xyxy                       # (4,) float32 pixels
        thing.kinds["mug"]                   # 0..1; all kinds sum to 1, "none" among them
        thing.colour                         # "red"
        thing.mask, thing.part("grip")       # (H, W) bool

Proposals (`proposals.py`) are cut out and shown to the network at 96 x 96; where it finds something, it
looks again, closer, and once more mirrored and turned.
`eye_card.md` says how it was trained (`make train`) and what it scores.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from a4agent.errors import require
from a4agent.imaging.masks import box_area, box_iou, box_overlap, tight_box
from a4agent.offline import proposals
from a4agent.offline.colour import name_of, well_lit
from a4agent.offline.networks import session, softmax
from a4agent.offline.saliency import saliency
from a4agent.offline.seen_object import SHOWN, SIDE, SeenObject, box_in_picture, main_piece
from a4agent.offline.vocabulary import IN_HAND, KINDS, NOTHING

if TYPE_CHECKING:
    from PIL.Image import Image

WEIGHTS = Path(__file__).with_name("eye.onnx")
COARSE_SIDE = 96
"""Pixels of the crops in which things are looked for, before they are looked at."""
IMAGE_SIDE = 1280
"""A larger picture is reduced to this first."""
MAIN = 0.5
"""How much is added to the objectness of what stands out most."""
CLOSER = 2
"""How often the network looks at what stands out most, each time around what it saw, before it counts."""
GOOD_LOOK = 0.4
"""A look is good if this is exceeded by its score times the share of what stands out that it shows."""
FARTHER = (2.0, 3.0)
"""The sides of the windows of farther looks, of the longer side of what was seen."""
ON_TOP = 0.5
"""How likely what lies on the main thing must be of its kind to be meant in its place."""
GROUND = 0.2
"""What the main thing lies on takes at least this share of the picture."""
SMALL = 0.5
"""A region is looked at from nearby if it is at most this share of its window wide and high."""
CLOSE = 2.2
"""The side of that nearby window, of the longer side of the region."""
LIKE = 0.4
"""What is seen from nearby counts if its size is at least this share of the region's, and at most its inverse."""
MOST_THINGS = 5
REMEMBERED = 8
LEAST = 0.0007
"""The least share of a window that a thing takes."""
LEAST_SIDE = 2
"""Pixels of the picture that a thing is wide and high."""


def look(image: Image, threads: int = 0) -> tuple[SeenObject, ...]:
    """The things in an RGB image, the likeliest first; empty where there is none.

    Raises:
        MissingExtraError: a package of the extra `offline` is missing.
        ModelFilesError: a network's file is missing or not the one that was tested.
    """
    rgb = np.asarray(image.convert("RGB"), np.uint8)
    digest = hashlib.blake2b(rgb.tobytes(), person=f"{rgb.shape[1]}x{rgb.shape[0]}".encode()[:16]).digest()
    with _lock:
        if digest in _seen:
            _seen.move_to_end(digest)
            return _seen[digest]
    found = _look(rgb, threads)
    with _lock:
        _seen[digest] = found
        while len(_seen) > REMEMBERED:
            _seen.popitem(last=False)
    return found


_seen: OrderedDict[bytes, tuple[SeenObject, ...]] = OrderedDict()
_lock = Lock()


def forget() -> None:
    """Let go of all remembered pictures."""
    with _lock:
        _seen.clear()


def look_closer(thing: SeenObject, region: np.ndarray, threads: int = 0) -> np.ndarray:
    """A region (SIDE, SIDE) bool of a thing's window as a mask (H, W) bool of the picture.

    A small one is looked at once more, from nearby: a handle that is three pixels wide in the drawer's window shows
    its outline there. Parts of tools and vessels are large in their window; from nearby they are taken for others.
    """
    cv2 = require("cv2", extra="offline")
    mask = thing.region(region)
    tight = tight_box(region)
    if tight is None or thing.likeliest[0] in IN_HAND or (tight[2:] - tight[:2]).max() > SMALL * SIDE:
        return mask
    near = _from_nearby(thing, region, threads)
    parts = thing.maps[:, region].mean(1)
    likely = near.maps[[k for k in range(1, len(parts)) if parts[k] > 0.3]].sum(0)
    _, pieces = cv2.connectedComponents(near.to_image(likely).astype(np.uint8))
    sizes = np.bincount(pieces.ravel())
    shared = np.bincount(pieces[mask], minlength=len(sizes))
    kept = shared > 0.2 * sizes
    kept[0] = False
    closer = kept[pieces]
    return closer if LIKE < closer.sum() / max(mask.sum(), 1) < 1 / LIKE else mask


def _from_nearby(thing: SeenObject, region: np.ndarray, threads: int) -> SeenObject:
    """The thing in a window around a region (SIDE, SIDE) bool; looked at once."""
    key = region.tobytes()
    if key not in thing.closer:
        scale = np.float32(thing.size_wh[0] / thing.looked_at.shape[1])
        window = proposals.around(thing.box_of(region), CLOSE)
        maps, _ = _ask(thing.looked_at, window / scale, threads, SIDE, many=True)
        thing.closer[key] = replace(thing, maps=maps[0], window=window[0])
    return thing.closer[key]


def _look(rgb: np.ndarray, threads: int) -> tuple[SeenObject, ...]:
    cv2 = require("cv2", extra="offline")
    height, width = rgb.shape[:2]
    if min(height, width) < 8 or int(rgb.max()) - int(rgb.min()) < 8:
        return ()
    shrink = min(1.0, IMAGE_SIDE / max(height, width))
    picture = cv2.resize(rgb, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA) if shrink < 1 else rgb
    picture = well_lit(picture)
    stands_out = saliency(picture, threads)
    windows = proposals.windows(picture, stands_out)
    found: list[SeenObject] = []
    box = proposals.main_box(picture, stands_out)
    if box is not None:
        found.append(_main_object(picture, stands_out, box, threads, (width, height)))
    maps, kinds = _ask(picture, windows, threads, COARSE_SIDE)
    for last in (False, True):
        boxes, scores = _boxes(maps, kinds, windows, picture.shape)
        scores[[_is_ground(box, found) for box in boxes * (width / picture.shape[1])]] = 0
        keep = _distinct(boxes, scores, MOST_THINGS)
        if not len(keep):
            return tuple(found)
        windows = proposals.around(boxes[keep])
        maps, kinds = _ask(picture, windows, threads, SIDE if last else COARSE_SIDE, many=last)
    boxes, scores = _boxes(maps, kinds, windows, picture.shape)
    for k in _distinct(boxes, scores, MOST_THINGS):
        thing = _seen_object(
            picture, stands_out, maps[k], kinds[k], windows[k], boxes[k], float(scores[k]), (width, height)
        )
        if not _is_ground(thing.box_xyxy, found) and all(box_iou(thing.box_xyxy, t.box_xyxy) < 0.5 for t in found):
            found.append(thing)
    return _on_top(found) if box is not None else tuple(found)


def _on_top(things: list[SeenObject]) -> tuple[SeenObject, ...]:
    """The things, and first of all the tool or vessel that lies on the main one, if that is no tool or vessel itself.

    A photograph of a hammer on a sheet of paper shows the hammer.
    """
    main, *others = things
    if main.likeliest[0] in IN_HAND:
        return tuple(things)
    held_by_main = [
        thing
        for thing in others
        if thing.likeliest[0] in IN_HAND
        and thing.likeliest[1] > ON_TOP
        and box_area(thing.box_xyxy) < 0.35 * box_area(main.box_xyxy)
        and box_overlap(thing.box_xyxy, main.box_xyxy) == box_area(thing.box_xyxy)
    ]
    if not held_by_main:
        return tuple(things)
    best = max(held_by_main, key=lambda thing: thing.objectness)
    rest = (thing for thing in others if thing is not best)
    swapped = replace(best, objectness=best.objectness + MAIN), replace(main, objectness=main.objectness - MAIN)
    return (*swapped, *rest)


def _main_object(
    rgb: np.ndarray, stands_out: np.ndarray, salient: np.ndarray, threads: int, size_wh: tuple[int, int]
) -> SeenObject:
    """What stands out most, of which the box `salient` (4,) may hold only a piece.

    The network looks around it, and again around what it saw.
    """
    box = salient
    for _ in range(CLOSER):
        box = _look_around(rgb, box, salient, threads, COARSE_SIDE).box_xyxy
    seen = _look_around(rgb, box, salient, threads, SIDE)
    return _seen_object(rgb, stands_out, seen.maps, seen.kinds, seen.window, seen.box_xyxy, seen.score + MAIN, size_wh)


class Glimpse(NamedTuple):
    """What a window shows: the thing's box (4,) and score, and maps and kinds of the window.

    `rank` is the score times the share of what stands out that the box holds.
    """

    box_xyxy: np.ndarray
    score: float
    rank: float
    maps: np.ndarray
    kinds: np.ndarray
    window: np.ndarray


def _look_around(rgb: np.ndarray, box: np.ndarray, salient: np.ndarray, threads: int, side: int) -> Glimpse:
    """What is in a box (4,); where that is no thing, or little of what is `salient` (4,), looked at from farther."""
    near = _best_glimpse(rgb, box, salient, (proposals.LOOSE,), threads, side)
    if near.rank > GOOD_LOOK:
        return near
    return max(near, _best_glimpse(rgb, box, salient, FARTHER, threads, side), key=lambda glimpse: glimpse.rank)


def _best_glimpse(
    rgb: np.ndarray, box: np.ndarray, salient: np.ndarray, distances: tuple[float, ...], threads: int, side: int
) -> Glimpse:
    windows = np.concatenate([proposals.around(box, loose) for loose in distances])
    maps, kinds = _ask(rgb, windows, threads, side, many=side == SIDE)
    seen, scores = _boxes(maps, kinds, windows, rgb.shape)
    ranks = scores * box_overlap(seen, salient) / max(float(box_area(salient)), 1.0)
    best = int(ranks.argmax())
    found = seen[best] if ranks[best] > 0 else box
    return Glimpse(found, float(scores[best]), float(ranks[best]), maps[best], kinds[best], windows[best])


def _is_ground(box: np.ndarray, found: list[SeenObject]) -> bool:
    """Whether a box holds the main thing and much of the picture: what it lies on."""
    if not found or not box.any():
        return False
    main, picture = found[0].box_xyxy, float(np.prod(found[0].size_wh))
    own = float(box_area(main))
    return bool(box_overlap(box, main) > 0.7 * own and box_area(box) > max(2 * own, GROUND * picture))


def _ask(
    rgb: np.ndarray, windows: np.ndarray, threads: int, side: int, many: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Part maps (n, 8, side, side) and kinds (n, 32) of windows; averaged over mirrored and turned crops if `many`."""
    crops = proposals.cut(rgb, windows, side).transpose(0, 3, 1, 2).astype(np.float32) / 127.5 - 1
    if not many:
        return _run(crops, threads)
    views = [_run(np.ascontiguousarray(turn(crops)), threads) for turn, _ in VIEWS]
    maps = np.mean([back(maps) for (maps, _), (_, back) in zip(views, VIEWS, strict=True)], 0)
    return maps, np.mean([kinds for _, kinds in views], 0)


VIEWS = (
    (lambda a: a, lambda a: a),
    (lambda a: a[..., ::-1], lambda a: a[..., ::-1]),
    (lambda a: np.rot90(a, 1, (2, 3)), lambda a: np.rot90(a, -1, (2, 3))),
    (lambda a: np.rot90(a, 2, (2, 3)), lambda a: np.rot90(a, -2, (2, 3))),
)
"""Ways to show a crop again, each with its way back."""


def _run(crops: np.ndarray, threads: int) -> tuple[np.ndarray, np.ndarray]:
    parts, kinds = session(WEIGHTS, threads).run(["parts", "kinds"], {"crops": crops})
    return softmax(parts), softmax(kinds)


def _boxes(
    maps: np.ndarray, kinds: np.ndarray, windows: np.ndarray, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """The box (n, 4) of the main thing in each window, in pixels, and how likely it is one whole thing (n,)."""
    boxes, scores = np.zeros((len(maps), 4), np.float32), np.zeros(len(maps), np.float32)
    pixels = maps.shape[-1]
    for index, window in enumerate(windows):
        likely = 1 - maps[index, NOTHING]
        shown = main_piece(likely > SHOWN)
        tight = tight_box(shown)
        if tight is None or shown.sum() < LEAST * pixels**2:
            continue
        box = box_in_picture(tight, window, pixels)
        cut_off = [tight[0] <= 0 < box[0], tight[1] <= 0 < box[1]]
        cut_off += [tight[2] >= pixels and box[2] < shape[1], tight[3] >= pixels and box[3] < shape[0]]
        box = np.clip(box, 0, [shape[1], shape[0], shape[1], shape[0]])
        if (box[2:] - box[:2]).min() < LEAST_SIDE:
            continue
        boxes[index] = box
        sure = float(likely[shown].mean())
        scores[index] = (1 - kinds[index, KINDS.index("none")]) * sure * 0.6 ** sum(cut_off)
    return boxes, scores


def _distinct(boxes: np.ndarray, scores: np.ndarray, most: int) -> np.ndarray:
    """Indices of the best boxes, none of which is much the same as a better one."""
    kept: list[int] = []
    for index in np.argsort(-scores):
        if scores[index] < 0.05 or len(kept) == most:
            break
        if all(box_iou(boxes[index], boxes[other]) < 0.5 for other in kept):
            kept.append(int(index))
    return np.array(kept, int)


def _seen_object(
    rgb: np.ndarray,
    stands_out: np.ndarray,
    maps: np.ndarray,
    kinds: np.ndarray,
    window: np.ndarray,
    box: np.ndarray,
    score: float,
    size_wh: tuple[int, int],
) -> SeenObject:
    scale = np.float32(size_wh[0] / rgb.shape[1])
    shown = main_piece(1 - maps[NOTHING] > SHOWN)
    contrast = 0.0
    if shown.any() and not shown.all():
        grey = np.repeat((stands_out * 255).astype(np.uint8)[..., None], 3, 2)
        salient = proposals.cut(grey, window[None], SIDE)[0, ..., 0] / 255
        contrast = float(salient[shown].mean() - salient[~shown].mean())
    colours = proposals.cut(rgb, window[None], SIDE)[0][shown]
    return SeenObject(
        box_xyxy=box * scale,
        kinds={name: float(value) for name, value in zip(KINDS, kinds, strict=True)},
        colour=name_of(colours),
        maps=maps,
        window=window * scale,
        size_wh=size_wh,
        objectness=score,
        contrast=contrast,
        looked_at=rgb,
    )
