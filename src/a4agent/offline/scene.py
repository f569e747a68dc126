"""One photograph as the offline detector and segmenter see it: its main object and every part they could mean.

    scene = scene_of(image)                       # remembered by the picture's content
    scene.region(wanted("the handle of the mug")) # (h, w) bool in the object's window
    scene.box_xyxy(region), scene.point_xy(region), scene.to_image(region)

Detector and segmenter share the analysis and nothing else: what the segmenter answers does not depend on
whether the detector was asked before.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from functools import cached_property
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np

from a4agent.offline import parts
from a4agent.offline.boxes import depth_in
from a4agent.offline.phrases import Wanted, everything
from a4agent.offline.silhouette import Silhouette, find_object

if TYPE_CHECKING:
    from PIL.Image import Image

REMEMBERED = 8


class Photograph:
    """`size_wh` of the photograph; `silhouette` of its main object, None if nothing stands out."""

    def __init__(self, rgb: np.ndarray, threads: int = 0) -> None:
        self.rgb = rgb
        self.size_wh = rgb.shape[1], rgb.shape[0]
        self.silhouette: Silhouette | None = find_object(rgb, threads)
        if self.silhouette is not None and not self.silhouette.mask.any():
            self.silhouette = None

    @cached_property
    def anatomy(self) -> parts.Anatomy | None:
        """The object's parts, None if there is no object."""
        return parts.Anatomy(self.silhouette) if self.silhouette else None

    def region(self, wanted: Wanted) -> np.ndarray | None:
        """The part (h, w) bool in the object's window; the whole object if it has no such part; None without object."""
        return self.anatomy.find(wanted) if self.anatomy else None

    @cached_property
    def candidates(self) -> list[np.ndarray]:
        """Every region that some phrase could mean, each (h, w) bool in the object's window."""
        if self.anatomy is None:
            return []
        found: dict[bytes, np.ndarray] = {}
        for wanted in everything():
            region = self.anatomy.find(wanted)
            found.setdefault(np.packbits(region).tobytes(), region)
        return list(found.values())

    def box_xyxy(self, region: np.ndarray) -> np.ndarray:
        """The box (4,) float32 around a region, in pixels of the image."""
        assert self.silhouette is not None
        x0, y0, x1, y1 = self.silhouette.box_xyxy
        scale = np.array([(x1 - x0) / region.shape[1], (y1 - y0) / region.shape[0]] * 2)
        rows, columns = np.flatnonzero(region.any(1)), np.flatnonzero(region.any(0))
        box = np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]) * scale + [x0, y0, x0, y0]
        return box.astype(np.float32)

    def point_xy(self, region: np.ndarray) -> np.ndarray:
        """The point (2,) float32 deepest inside a region, in pixels of the image."""
        assert self.silhouette is not None
        depth = depth_in(region)
        row, column = np.unravel_index(depth.argmax(), depth.shape)
        x0, y0, x1, y1 = self.silhouette.box_xyxy
        height, width = region.shape
        return np.array([x0 + (column + 0.5) * (x1 - x0) / width, y0 + (row + 0.5) * (y1 - y0) / height], np.float32)

    def to_image(self, region: np.ndarray) -> np.ndarray:
        """The region as a mask (H, W) bool of the image."""
        assert self.silhouette is not None
        return self.silhouette.to_image(region, self.size_wh)


_scenes: OrderedDict[tuple[bytes, int], Photograph] = OrderedDict()
_lock = Lock()


def scene_of(image: Image, threads: int = 0) -> Photograph:
    """The analysis of an RGB image; the last REMEMBERED pictures are not analysed twice."""
    rgb = np.asarray(image.convert("RGB"), np.uint8)
    digest = hashlib.blake2b(rgb.tobytes(), person=f"{rgb.shape[1]}x{rgb.shape[0]}".encode()[:16]).digest()
    key = digest, threads
    with _lock:
        if key in _scenes:
            _scenes.move_to_end(key)
            return _scenes[key]
    scene = Photograph(rgb, threads)
    with _lock:
        _scenes[key] = scene
        while len(_scenes) > REMEMBERED:
            _scenes.popitem(last=False)
    return scene


def forget() -> None:
    """Let go of all remembered pictures."""
    with _lock:
        _scenes.clear()
