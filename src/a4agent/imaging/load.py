"""The only place where pictures are decoded: by named formats, after their size in bytes and pixels is checked.

load_image("mug.heic")           -> an upright 8-bit RGB `PIL.Image`, or an error that says why not
read_pixels("mask.png")          -> the array as it is stored, without alpha: masks and region numbers
"""

from __future__ import annotations

import errno
import hashlib
import io
import os
import threading
import warnings
import weakref
from collections.abc import Generator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from PIL import ExifTags, UnidentifiedImageError
from PIL import Image as Pillow
from PIL.Image import Image, Transpose

from a4agent.errors import A4Error, InputError, ResourceError, require

MAX_PIXELS = 100_000_000
MAX_BYTES = 500_000_000
HEIC = frozenset({".heic", ".heif"})
SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".gif", ".ppm", ".avif"}) | HEIC
UNREAD = frozenset({".jxl", ".jp2", ".tga", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".psd"})
"""Formats of photographs that have to be converted first."""
FORMATS = ("JPEG", "PNG", "BMP", "GIF", "PPM", "WEBP", "TIFF", "AVIF")
"""Pillow's names of the formats that are decoded: some of its other decoders are untested or start programs."""
HEIF_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
ANSWER_PICTURES = ("mask.png", "overlay.png", "imagination.png")
"""The pictures that a saved answer may have."""
EXHAUSTED = (errno.EMFILE, errno.ENFILE, errno.ENOMEM)
_TURN = threading.Lock()
_HASHES: dict[int, tuple[weakref.ref[Image], str]] = {}


class TooManyPixels(InputError):
    """A picture larger than the limit, told from its header."""


def load_image(
    source: str | Path | bytes | np.ndarray | Image,
    *,
    max_pixels: int = MAX_PIXELS,
    shrink_to: int | None = None,
    inside: str | Path | None = None,
) -> Image:
    """An RGB picture from a path, the bytes of a file, a uint8 array (H, W, 3) or (H, W), or a PIL image.

    EXIF rotation is applied, the first frame of an animation taken, transparency laid on white, 16 bits
    brought to 8. A picture of more than `shrink_to` pixels is scaled down. A path must lead to a file `inside` that
    folder, if one is given, links followed.

    Raises:
        InputError: missing, empty, too large, cut off, outside the folder, or not an image.
        TooManyPixels: an InputError too, for more than `max_pixels` pixels.
        MissingExtraError: an HEIC picture without the extra `heif`.
    """
    if isinstance(source, Pillow.Image):
        with _explained("the image"):
            return _to_rgb(source, "the image", max_pixels, shrink_to)
    if isinstance(source, np.ndarray):
        return _to_rgb(_from_array(source), "the image", max_pixels, shrink_to)
    with _opened(source, max_pixels, inside) as (image, name):
        return _to_rgb(image, name, max_pixels, shrink_to)


def read_pixels(
    source: str | Path | bytes, *, max_pixels: int = MAX_PIXELS, inside: str | Path | None = None
) -> np.ndarray:
    """The pixels (H, W) or (H, W, 3) of a picture as they are stored (palette indices, 16 bits), without alpha.

    Raises:
        InputError: as `load_image`.
    """
    with _opened(source, max_pixels, inside) as (image, _):
        if image.mode in ("RGBA", "LA", "PA"):
            image = image.convert({"RGBA": "RGB", "LA": "L", "PA": "RGB"}[image.mode])
        return np.array(image)


@contextmanager
def _opened(
    source: str | Path | bytes, max_pixels: int, inside: str | Path | None
) -> Generator[tuple[Image, str], None, None]:
    """A picture whose header has been read and checked, and its name for errors."""
    if isinstance(source, bytes):
        with _explained("the image"), _identified(io.BytesIO(source), "the image", len(source), max_pixels) as image:
            yield image, "the image"
        return
    if not isinstance(cast(Any, source), (str, os.PathLike)):
        raise InputError(f"an image is a path, bytes, an array or a PIL image, not {type(source).__name__}")
    path, name = Path(source), repr(str(source))
    try:
        if inside is not None and not path.resolve().is_relative_to(Path(inside).resolve()):
            raise InputError(f"{name} is outside the folder {str(inside)!r}")
        size = path.stat().st_size
        if not path.is_file():  # a pipe would block, a device never end
            raise InputError(f"{name} is {'a folder' if path.is_dir() else 'a pipe or device'}, not an image file")
        file = path.open("rb")
    except FileNotFoundError as error:
        raise InputError(f"no such image: {name}") from error
    except (OSError, ValueError, RuntimeError) as error:  # RuntimeError: a loop of links
        raise _unreadable(f"{name} cannot be read", error) from error
    with file, _explained(name), _identified(file, name, size, max_pixels) as image:
        yield image, name


def _identified(file: IO[bytes], name: str, size: int, max_pixels: int) -> Image:
    """The picture, not yet decoded."""
    if size == 0:
        raise InputError(f"{name} is an empty file")
    if size > MAX_BYTES:
        raise InputError(f"{name} has {size // 1_000_000} MB, over the limit of {MAX_BYTES // 1_000_000} MB")
    head = file.read(12)
    file.seek(0)
    formats = FORMATS
    if head[4:8] == b"ftyp" and head[8:12] in HEIF_BRANDS:
        heif: Any = require("pillow_heif", extra="heif")
        heif.register_heif_opener()
        formats = ("HEIF",)
    with _reading_headers():
        image = Pillow.open(file, formats=formats)
    _check_pixels(image, name, max_pixels)
    return image


@contextmanager
def _reading_headers() -> Generator[None, None, None]:
    """Without Pillow's own pixel limit, as ours applies, and without its warnings of broken EXIF.

    Limit and warnings belong to the whole process, so threads take turns.
    """
    with _TURN, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        limit, Pillow.MAX_IMAGE_PIXELS = Pillow.MAX_IMAGE_PIXELS, None
        try:
            yield
        finally:
            Pillow.MAX_IMAGE_PIXELS = limit


@contextmanager
def _explained(name: str) -> Generator[None, None, None]:
    """Turn any error of a decoder into an InputError that names the picture."""
    try:
        yield
    except A4Error:
        raise
    except UnidentifiedImageError as error:
        raise InputError(
            f"{name} is not an image in a format that can be read (JPEG, PNG, WebP, AVIF, HEIC, BMP, TIFF, GIF, PPM)"
        ) from error
    except (OSError, SyntaxError, ValueError, EOFError, IndexError, TypeError, KeyError) as error:
        raise _unreadable(f"{name} is damaged or cut off", error) from error
    except Exception as error:  # decoders raise struct.error, zlib.error and more of their own
        raise InputError(f"{name} cannot be decoded: {error!r}") from error


def _unreadable(what: str, error: Exception) -> InputError | ResourceError:
    """An InputError, or a ResourceError where the process has run out of file handles or memory."""
    if isinstance(error, OSError) and error.errno in EXHAUSTED:
        return ResourceError(f"no file can be opened ({error}); close other programs, or raise the limit (`ulimit -n`)")
    return InputError(f"{what}: {error}")


def _from_array(array: np.ndarray) -> Image:
    if array.dtype != np.uint8 or array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] not in (3, 4)):
        raise InputError(f"an image array is uint8 of shape (H, W, 3), not {array.dtype} of {array.shape}")
    if not array.size:
        raise InputError(f"an image array without pixels: {array.shape}")
    return Pillow.fromarray(array)


def _check_pixels(image: Image, name: str, max_pixels: int) -> None:
    width, height = image.size
    if width * height > max_pixels:
        raise TooManyPixels(
            f"{name} has {width} x {height} pixels, over the limit of {max_pixels}; raise the setting image.max_pixels"
        )
    if width * height == 0:
        raise InputError(f"{name} has no pixels")


def _to_rgb(image: Image, name: str, max_pixels: int, shrink_to: int | None) -> Image:
    _check_pixels(image, name, max_pixels)
    smaller = None
    if shrink_to is not None and image.width * image.height > shrink_to:
        scale = (shrink_to / (image.width * image.height)) ** 0.5
        smaller = max(int(image.width * scale), 1), max(int(image.height * scale), 1)
        image.draft(None, smaller)  # a JPEG is decoded at half its size or less, and never below this one
    upright = _upright(image)
    if upright.mode in ("I", "F") or upright.mode.startswith("I;16"):
        upright = Pillow.fromarray(_to_8_bit(np.asarray(upright)))
    if upright.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in upright.info:
        upright = upright.convert("RGBA")
        ground = Pillow.new("RGBA", upright.size, "white")
        upright = Pillow.alpha_composite(ground, upright)
    rgb = upright.convert("RGB")
    if smaller is not None:
        rgb.thumbnail((max(smaller), max(smaller)), Pillow.Resampling.LANCZOS)
    rgb.info.clear()  # its EXIF would turn it again
    return rgb


def _upright(image: Image) -> Image:
    """The picture turned as its EXIF says, if that can be read.

    Pillow's own `exif_transpose` refuses pictures with other tags that it cannot read or write again.
    """
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
    """A sha256 over mode, size and pixels, whatever file they came from.

    Computed once for each image object, which must not change afterwards.
    """
    number = id(image)
    known = _HASHES.get(number)
    if known is not None and known[0]() is image:
        return known[1]
    name = _hash_pixels(image)
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
