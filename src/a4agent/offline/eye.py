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
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from a4agent.errors import require
from a4agent.imaging.masks import iou, tight_box
from a4agent.offline import proposals
from a4agent.offline.colour import name_of, well_lit
from a4agent.offline.parts import Anatomy
from a4agent.offline.saliency import saliency
from a4agent.offline.silhouette import Silhouette, enlarged, find_object
from a4agent.offline.vocabulary import KINDS, NOTHING, PARTS

if TYPE_CHECKING:
    from PIL.Image import Image

WEIGHTS = Path(__file__).with_name("eye.onnx")
SIDE = 160
COARSE_SIDE = 96
"""Pixels of the crops in which things are looked for, before they are looked at."""
IMAGE_SIDE = 1280
"""A larger picture is reduced to this first."""
MAIN = 1.5
"""The objectness of what stands out most; that of other things is at most 1."""
AGREED = 0.5
"""An outline by colour counts if it overlaps what the network sees there by this much."""
GROUND = 0.2
"""What the main thing lies on takes at least this share of the picture."""
MOST_THINGS = 5
REMEMBERED = 8
LEAST = 0.0007
"""The least share of a window that a thing takes."""
SHOWN = 0.5
"""A pixel belongs to a thing if "nothing" is less likely than this."""


@dataclass(frozen=True, eq=False)
class SeenObject:
    """One thing: its box, kinds, colour, and part maps (8, SIDE, SIDE) of probabilities in a square `window`.

    `window` is centre x, centre y and side in pixels of the picture of `size_wh`; `objectness` says how sure it
    is that this is one whole thing, `contrast` how much more it stands out than what is around it. `silhouette` is its
    outline by colour, which only what stands out most has.
    """

    box_xyxy: np.ndarray
    kinds: Mapping[str, float]
    colour: str
    maps: np.ndarray
    window: np.ndarray
    size_wh: tuple[int, int]
    objectness: float
    contrast: float
    silhouette: Silhouette | None = None

    @cached_property
    def anatomy(self) -> Anatomy | None:
        """Its parts by their shape, if its outline is known."""
        return Anatomy(self.silhouette) if self.silhouette else None

    @cached_property
    def shown(self) -> np.ndarray:
        """The thing in its window, (SIDE, SIDE) bool: its largest connected piece and pieces close to it."""
        return _main_piece(1 - self.maps[NOTHING] > SHOWN)

    @cached_property
    def mask(self) -> np.ndarray:
        """The thing in the picture, (H, W) bool."""
        return self.to_image((1 - self.maps[NOTHING]) * self.shown_softly)

    def part(self, *names: str) -> np.ndarray:
        """The parts with these names in the window, (SIDE, SIDE) bool: where one of them is the likeliest part."""
        wanted = [PARTS.index(name) for name in names]
        likeliest = 1 + self.maps[1:].argmax(0)
        return np.isin(likeliest, wanted) & self.shown

    @cached_property
    def shown_softly(self) -> np.ndarray:
        """`shown` with a margin of two pixels, (SIDE, SIDE) float32."""
        cv2 = require("cv2", extra="offline")
        return cv2.dilate(self.shown.astype(np.float32), np.ones((5, 5), np.uint8))

    def region(self, region: np.ndarray) -> np.ndarray:
        """A region (SIDE, SIDE) bool of the window, in the picture, (H, W) bool."""
        cv2 = require("cv2", extra="offline")
        return self.to_image(cv2.GaussianBlur(region.astype(np.float32), (0, 0), 0.7))

    def in_window(self, mask: np.ndarray) -> np.ndarray:
        """A mask (H, W) bool of the picture as the window shows it, (SIDE, SIDE) bool."""
        stencil = np.repeat(mask[..., None] * np.uint8(255), 3, 2)
        return proposals.cut(stencil, self.window[None], SIDE)[0, ..., 0] > 127

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
            likely.astype(np.float32), matrix, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        )
        return soft > SHOWN


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


def _look(rgb: np.ndarray, threads: int) -> tuple[SeenObject, ...]:
    cv2 = require("cv2", extra="offline")
    height, width = rgb.shape[:2]
    if min(height, width) < 8 or int(rgb.max()) - int(rgb.min()) < 8:
        return ()
    shrink = min(1.0, IMAGE_SIDE / max(height, width))
    picture = cv2.resize(rgb, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA) if shrink < 1 else rgb
    stands_out = saliency(well_lit(picture), threads)
    silhouette = find_object(picture, threads, stands_out)
    windows = proposals.windows(picture, stands_out)
    found: list[SeenObject] = []
    if silhouette is not None:
        main = _outlined(picture, stands_out, silhouette, threads, (width, height))
        if main.silhouette:
            found.append(main)
        windows = np.concatenate([main.window[None] * picture.shape[1] / width, windows])
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
        if not _is_ground(thing.box_xyxy, found) and all(_overlap(thing.box_xyxy, t.box_xyxy) < 0.5 for t in found):
            found.append(thing)
    return tuple(found)


def _outlined(
    rgb: np.ndarray, stands_out: np.ndarray, silhouette: Silhouette, threads: int, size_wh: tuple[int, int]
) -> SeenObject:
    """The thing with this silhouette, which it keeps if the network sees a thing of that shape there too."""
    mask = silhouette.to_image(silhouette.mask, (rgb.shape[1], rgb.shape[0]))
    box = tight_box(mask)
    box = np.array(silhouette.box_xyxy, np.float32) if box is None else box
    windows = proposals.around(box)
    maps, kinds = _ask(rgb, windows, threads, SIDE, many=True)
    stencil = np.repeat(mask[..., None] * np.uint8(255), 3, 2)
    outlined = proposals.cut(stencil, windows, SIDE)[0, ..., 0].astype(np.float32) / 255
    seen = 1 - maps[0, NOTHING]
    agreed = iou(seen > SHOWN, outlined > SHOWN) >= AGREED
    if agreed:
        shown = (seen + outlined) / 2
        maps[0, 1:] *= shown / np.maximum(seen, 1e-6)
        maps[0, NOTHING] = 1 - shown
    thing = _seen_object(rgb, stands_out, maps[0], kinds[0], windows[0], box, MAIN, size_wh)
    whole = enlarged(silhouette, size_wh[0] / rgb.shape[1], size_wh)
    return replace(thing, silhouette=whole) if agreed else thing


def _is_ground(box: np.ndarray, found: list[SeenObject]) -> bool:
    """Whether a box holds the main thing and much of the picture: what it lies on."""
    if not found or not box.any():
        return False
    main, picture = found[0].box_xyxy, float(np.prod(found[0].size_wh))
    shared = float(np.maximum(0.0, np.minimum(box[2:], main[2:]) - np.maximum(box[:2], main[:2])).prod())
    area, own = float((box[2:] - box[:2]).prod()), float((main[2:] - main[:2]).prod())
    return shared > 0.7 * own and area > max(2 * own, GROUND * picture)


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
    parts, kinds = _session(threads).run(["parts", "kinds"], {"crops": crops})
    return _softmax(parts), _softmax(kinds)


def _softmax(logits: np.ndarray) -> np.ndarray:
    powers = np.exp(logits - logits.max(1, keepdims=True))
    return powers / powers.sum(1, keepdims=True)


@lru_cache(maxsize=4)
def _session(threads: int) -> Any:
    onnxruntime = require("onnxruntime", extra="offline")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return onnxruntime.InferenceSession(WEIGHTS.read_bytes(), options, providers=["CPUExecutionProvider"])


def _boxes(
    maps: np.ndarray, kinds: np.ndarray, windows: np.ndarray, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """The box (n, 4) of the main thing in each window, in pixels, and how likely it is one whole thing (n,)."""
    boxes, scores = np.zeros((len(maps), 4), np.float32), np.zeros(len(maps), np.float32)
    pixels = maps.shape[-1]
    for index, (x, y, side) in enumerate(windows):
        likely = 1 - maps[index, NOTHING]
        shown = _main_piece(likely > SHOWN)
        if shown.sum() < LEAST * pixels**2:
            continue
        rows, columns = np.flatnonzero(shown.any(1)), np.flatnonzero(shown.any(0))
        tight = np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1])
        box = np.array([x, y, x, y]) - side / 2 + tight * side / pixels
        cut_off = [tight[0] <= 0 < box[0], tight[1] <= 0 < box[1]]
        cut_off += [tight[2] >= pixels and box[2] < shape[1], tight[3] >= pixels and box[3] < shape[0]]
        boxes[index] = np.clip(box, 0, [shape[1], shape[0], shape[1], shape[0]])
        sure = float(likely[shown].mean())
        scores[index] = (1 - kinds[index, KINDS.index("none")]) * sure * 0.6 ** sum(cut_off)
    return boxes, scores


def _main_piece(mask: np.ndarray) -> np.ndarray:
    """The largest connected piece of a mask (h, w) bool, with pieces within three pixels of it."""
    cv2 = require("cv2", extra="offline")
    near = cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8))
    _, labels = cv2.connectedComponents(near)
    sizes = np.bincount(labels[mask], minlength=2)
    sizes[0] = 0
    return mask & (labels == sizes.argmax()) if sizes.max() else mask


def _distinct(boxes: np.ndarray, scores: np.ndarray, most: int) -> np.ndarray:
    """Indices of the best boxes, none of which is much the same as a better one."""
    kept: list[int] = []
    for index in np.argsort(-scores):
        if scores[index] < 0.05 or len(kept) == most:
            break
        if all(_overlap(boxes[index], boxes[other]) < 0.5 for other in kept):
            kept.append(int(index))
    return np.array(kept, int)


def _overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two boxes (4,)."""
    sides = np.maximum(0.0, np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]))
    shared = float(sides.prod())
    union = float((a[2:] - a[:2]).prod() + (b[2:] - b[:2]).prod()) - shared
    return shared / union if union > 0 else 0.0


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
    shown = _main_piece(1 - maps[NOTHING] > SHOWN)
    inside = proposals.cut(np.repeat((stands_out * 255).astype(np.uint8)[..., None], 3, 2), window[None], SIDE)[
        0, ..., 0
    ]
    contrast = (
        (float(inside[shown].mean()) - float(inside[~shown].mean())) / 255 if shown.any() and not shown.all() else 0.0
    )
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
    )
