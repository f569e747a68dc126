"""Pictures in: whatever a person has becomes an upright 8-bit RGB `PIL.Image`, or an error that says why not."""

from __future__ import annotations

import hashlib
import io
import os
import threading
import warnings
import weakref
from collections.abc import Generator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast

import numpy as np

from a4agent.errors import InputError

if TYPE_CHECKING:
    from PIL.Image import Image

MAX_PIXELS = 100_000_000
SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".gif", ".ppm"})
UNREAD = frozenset({".heic", ".heif", ".avif", ".jxl", ".jp2", ".tga", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".psd"})
"""What people have photographs in and has to be converted first."""
FORMATS = ("JPEG", "PNG", "BMP", "GIF", "PPM", "WEBP", "TIFF")
"""Pillow's names of what is decoded, whoever sends it: of its other decoders some are untested or start programs."""
ANSWER_PICTURES = ("mask.png", "overlay.png", "imagination.png")
"""What a saved answer may have beside its affordance.json."""
_TURN = threading.Lock()
_HASHES: dict[int, tuple[weakref.ref[Image], str]] = {}


class TooManyPixels(InputError):
    """A picture larger than the limit, told from its header."""


def load_image(source: str | Path | bytes | np.ndarray | Image, *, max_pixels: int = MAX_PIXELS) -> Image:
    """An RGB picture from a path, the bytes of a file, a uint8 array (H, W, 3) or (H, W), or a PIL image.

    EXIF rotation is applied, the first frame of an animation taken, transparency laid on white, 16 bits
    brought to 8.

    Raises:
        InputError: not there, empty, cut off or not an image.
        TooManyPixels: an InputError too, for more than `max_pixels` pixels.
    """
    from PIL import Image

    if isinstance(source, Image.Image):
        with _explained("the image"):
            return _to_rgb(source, "the image", max_pixels)
    if isinstance(source, np.ndarray):
        return _from_array(source, max_pixels)
    if isinstance(source, bytes):
        return _from_file(io.BytesIO(source), "the image", len(source), max_pixels)
    if not isinstance(cast(Any, source), (str, os.PathLike)):
        raise InputError(f"an image is a path, bytes, an array or a PIL image, not {type(source).__name__}")
    path = Path(source)
    try:
        size = path.stat().st_size
        if not path.is_file():  # a pipe would block, a device never end
            raise InputError(
                f"{str(path)!r} is {'a folder' if path.is_dir() else 'a pipe or device'}, not an image file"
            )
        with path.open("rb") as file:
            return _from_file(file, repr(str(path)), size, max_pixels)
    except FileNotFoundError as error:
        raise InputError(f"no such image: {str(path)!r}") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{str(path)!r} cannot be read: {error}") from error


def _from_file(file: IO[bytes], name: str, size: int, max_pixels: int) -> Image:
    if size == 0:
        raise InputError(f"{name} is an empty file")
    with _explained(name), _open(file) as image:
        return _to_rgb(image, name, max_pixels)


def _open(file: IO[bytes]) -> Image:
    """The picture, not yet decoded."""
    from PIL import Image

    with _reading_headers():
        return Image.open(file, formats=FORMATS)


@contextmanager
def _reading_headers() -> Generator[None, None, None]:
    """Without Pillow's own limit of pixels, which gives way to ours, and without its warnings of broken EXIF.

    Limit and warnings belong to the whole process, so threads take turns.
    """
    from PIL import Image

    with _TURN, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            yield
        finally:
            Image.MAX_IMAGE_PIXELS = limit


@contextmanager
def _explained(name: str) -> Generator[None, None, None]:
    """Turn whatever a decoder raises into an InputError that names the picture."""
    from PIL import UnidentifiedImageError

    try:
        yield
    except InputError:
        raise
    except UnidentifiedImageError as error:
        raise InputError(
            f"{name} is not an image in a format that can be read (JPEG, PNG, WebP, BMP, TIFF, GIF, PPM)"
        ) from error
    except (OSError, SyntaxError, ValueError, EOFError, IndexError, TypeError, KeyError) as error:
        raise InputError(f"{name} is damaged or cut off: {error}") from error
    except Exception as error:  # decoders raise struct.error, zlib.error and more of their own
        raise InputError(f"{name} cannot be decoded: {error!r}") from error


def _from_array(array: np.ndarray, max_pixels: int) -> Image:
    from PIL import Image

    if array.dtype != np.uint8 or array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] not in (3, 4)):
        raise InputError(f"an image array is uint8 of shape (H, W, 3), not {array.dtype} of {array.shape}")
    if not array.size:
        raise InputError(f"an image array without pixels: {array.shape}")
    return _to_rgb(Image.fromarray(array), "the image", max_pixels)


def _to_rgb(image: Image, name: str, max_pixels: int) -> Image:
    from PIL import Image

    width, height = image.size
    if width * height > max_pixels:
        raise TooManyPixels(
            f"{name} has {width} x {height} pixels, over the limit of {max_pixels}; raise the setting image.max_pixels"
        )
    if width * height == 0:
        raise InputError(f"{name} has no pixels")
    upright = _upright(image)
    if upright.mode in ("I", "F") or upright.mode.startswith("I;16"):
        upright = Image.fromarray(_to_8_bit(np.asarray(upright)))
    if upright.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in upright.info:
        upright = upright.convert("RGBA")
        ground = Image.new("RGBA", upright.size, "white")
        upright = Image.alpha_composite(ground, upright)
    rgb = upright.convert("RGB")
    rgb.info.clear()  # its EXIF would turn it again
    return rgb


def _upright(image: Image) -> Image:
    """The picture turned as its EXIF says, if that can be read: whatever else stands there, the pixels decide.

    Pillow's own `exif_transpose` refuses pictures whose other tags it cannot read or write anew.
    """
    from PIL import ExifTags
    from PIL.Image import Transpose

    with _reading_headers() if image.format == "TIFF" else nullcontext():  # its EXIF is read with the pixels
        image.load()
    with _reading_headers():
        try:
            orientation = image.getexif().get(ExifTags.Base.Orientation, 1)
        except Exception:  # SyntaxError, struct.error and more
            return image
    turn = {
        2: Transpose.FLIP_LEFT_RIGHT,
        3: Transpose.ROTATE_180,
        4: Transpose.FLIP_TOP_BOTTOM,
        5: Transpose.TRANSPOSE,
        6: Transpose.ROTATE_270,
        7: Transpose.TRANSVERSE,
        8: Transpose.ROTATE_90,
    }.get(orientation)
    return image if turn is None else image.transpose(turn)


def _to_8_bit(samples: np.ndarray) -> np.ndarray:
    """16-bit counts by their full scale; floats and wide integers that exceed it by their own range."""
    values = samples.astype(np.float32 if samples.dtype.itemsize <= 2 else np.float64)
    values = np.where(np.isfinite(values), values, 0.0)
    low, high = float(values.min(initial=0.0)), float(values.max(initial=0.0))
    if samples.dtype.kind == "f" and high <= 1.0 and low >= 0.0:
        scale = 1.0
    elif low >= 0.0 and high <= 255.0 and samples.dtype.itemsize > 2:
        scale = 255.0
    elif low >= 0.0 and high <= 65535.0:
        scale = 65535.0
    else:
        values, scale = values - low, max(high - low, 1e-12)
    return np.clip(values / scale * 255.0 + 0.5, 0, 255).astype(np.uint8)


def image_hash(image: Image) -> str:
    """A sha256 over size and pixels: the same picture has the same name, whatever file it came from.

    Computed once for an image object, which counts as unchanging.
    """
    known = _HASHES.get(id(image))
    if known is not None and known[0]() is image:
        return known[1]
    number, name = id(image), _hash_pixels(image)
    _HASHES[number] = (weakref.ref(image, lambda _: _HASHES.pop(number, None)), name)
    return name


def _hash_pixels(image: Image) -> str:
    digest = hashlib.sha256(f"{image.mode} {image.size} ".encode())
    digest.update(image.tobytes())
    return digest.hexdigest()


def find_images(folder: Path, suffixes: frozenset[str] = SUFFIXES) -> list[Path]:
    """All such files below `folder`, sorted; hidden ones and the pictures of saved answers are left out."""
    return sorted(
        path
        for path in folder.rglob("*")
        if path.suffix.lower() in suffixes
        and path.is_file()
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)
        and not (path.name in ANSWER_PICTURES and path.with_name("affordance.json").is_file())
    )
