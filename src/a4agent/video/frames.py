"""Frames from a video file, a folder of images or a camera, and an overlay video out.

    with open_frames("kitchen.mp4") as frames:
        frames.rate, frames.count                 # 30.0, 240 (None for a camera)
        for index, picture in frames: ...         # 0, PIL.Image in RGB

A video that is cut off ends the iteration early, with the reason in `frames.ended_early`.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Pillow
from PIL.Image import Image

from a4agent.errors import InputError, require
from a4agent.imaging.load import find_images, load_image

FOLDER_RATE = 10.0
"""Frames per second of a folder of images."""
TINT = np.array([255, 61, 127], np.float32)

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read when the first file is opened; errors are reported here


class Frames(ABC):
    """An open source of frames; iterate once. `count` is None where it is unknown."""

    def __init__(self, rate: float, count: int | None) -> None:
        self.rate = rate
        self.count = count
        self.ended_early = ""

    @abstractmethod
    def __iter__(self) -> Iterator[tuple[int, Image]]: ...

    def __enter__(self) -> Frames:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        return None


def open_frames(source: str | Path) -> Frames:
    """A video file, a folder of images (sorted by name), or "camera:0".

    Raises:
        InputError: it does not exist, has no frames, or cannot be decoded.
        MissingExtraError: OpenCV is not installed, which decodes videos and reads cameras.
    """
    name = str(source)
    if name.startswith("camera:"):
        number = name.removeprefix("camera:")
        if not number.isdigit():
            raise InputError(f"a camera is 'camera:NUMBER', such as 'camera:0', not {name!r}")
        return _Capture(name, int(number))
    path = Path(name)
    if path.is_dir():
        images = find_images(path)
        if not images:
            raise InputError(f"no images in the folder {name!r}")
        return _Folder(images)
    if not path.exists():
        raise InputError(f"no such video or folder: {name!r}")
    if not path.is_file() or not os.path.getsize(path):
        raise InputError(f"{name!r} is not a video file")
    return _Capture(name, str(path))


class _Folder(Frames):
    def __init__(self, images: Sequence[Path]) -> None:
        super().__init__(FOLDER_RATE, len(images))
        self._images = images

    def __iter__(self) -> Iterator[tuple[int, Image]]:
        for index, path in enumerate(self._images):
            try:
                yield index, load_image(path)
            except InputError as error:
                self.ended_early = str(error)
                return


class _Capture(Frames):
    """OpenCV's decoder; a camera is a capture that never ends."""

    def __init__(self, name: str, source: str | int) -> None:
        cv2: Any = require("cv2", extra="offline")
        self._cv2 = cv2
        self._name = name
        level = cv2.utils.logging.setLogLevel(0)
        try:
            self._capture = cv2.VideoCapture(source)
        finally:
            cv2.utils.logging.setLogLevel(level)
        if not self._capture.isOpened():
            if isinstance(source, int):
                raise InputError(f"cannot open {name!r}: no camera of that number, or another program uses it")
            raise InputError(
                f"cannot open the video {name!r}: it is damaged, or in a format other than MP4 and the like"
            )
        rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT)) if isinstance(source, str) else 0
        super().__init__(rate if 0 < rate < 1000 else 30.0, count if count > 0 else None)

    def __iter__(self) -> Iterator[tuple[int, Image]]:
        index = 0
        while True:
            read, pixels = self._capture.read()
            if not read:
                break
            yield index, Pillow.fromarray(self._cv2.cvtColor(pixels, self._cv2.COLOR_BGR2RGB))
            index += 1
        if index == 0:
            raise InputError(f"{self._name!r} has no frames that can be decoded")
        if self.count is not None and index < self.count:
            self.ended_early = f"{self._name!r} breaks off after {index} of {self.count} frames"

    def close(self) -> None:
        self._capture.release()


class OverlayVideo:
    """Writes an MP4 with the mask tinted and outlined; a frame without a mask is written as it is."""

    def __init__(self, path: Path, rate: float) -> None:
        self._cv2: Any = require("cv2", extra="offline")
        self._path = path
        self._rate = rate
        self._writer: Any = None
        self._size = (0, 0)

    def write(self, frame: Image, mask: np.ndarray, label: str, certain: bool) -> None:
        """Add a frame; `label` is drawn in its corner, and `certain` is False for a mask that is only a guess.

        Raises:
            InputError: the file cannot be written.
        """
        cv2 = self._cv2
        pixels = np.ascontiguousarray(np.asarray(frame)[..., ::-1])
        colour = TINT[::-1]
        if certain and mask.any():
            pixels[mask] = (0.55 * pixels[mask] + 0.45 * colour).astype(np.uint8)
        outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(pixels, outlines, -1, colour.tolist(), 2)
        for thickness, shade in ((4, (16, 18, 24)), (1, (255, 255, 255))):
            cv2.putText(pixels, label, (10, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.6, shade, thickness, cv2.LINE_AA)
        size = (pixels.shape[1] // 2 * 2, pixels.shape[0] // 2 * 2)  # the codec wants even sides
        if self._writer is None:
            self._size = size
            self._writer = cv2.VideoWriter(str(self._path), cv2.VideoWriter_fourcc(*"mp4v"), self._rate, size)
            if not self._writer.isOpened():
                raise InputError(f"cannot write {str(self._path)!r}; choose another folder with --out")
        if size != self._size:
            pixels = cv2.resize(pixels, self._size)
        self._writer.write(pixels[: self._size[1], : self._size[0]])

    def close(self) -> None:
        """Finish the file. Safe to call twice."""
        if self._writer is not None:
            self._writer.release()
            self._writer = None
