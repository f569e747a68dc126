"""Pictures in: every format and every kind of damage."""

from __future__ import annotations

import gc
import io
import os
import struct
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageOps

from a4agent.errors import InputError
from a4agent.imaging import load
from a4agent.imaging.load import find_images, image_hash, load_image

PIXELS = np.random.default_rng(0).integers(0, 255, (40, 60, 3), dtype=np.uint8)
PHOTO = Image.fromarray(PIXELS)


def encoded(image: Image.Image, kind: str, **options: object) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)  # type: ignore[arg-type]
    return buffer.getvalue()


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "MPO", "WEBP", "BMP", "TIFF", "GIF", "PPM"])
def test_common_formats(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "photo"
    path.write_bytes(encoded(PHOTO, kind))
    image = load_image(path)
    assert (image.mode, image.size) == ("RGB", (60, 40))


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGBA", "CMYK", "YCbCr", "LAB", "HSV", "I", "F"])
def test_every_mode_becomes_rgb(mode: str) -> None:
    source = PHOTO.convert("L").convert(mode) if mode in ("I", "F", "LA") else PHOTO.convert("RGB").convert(mode)
    assert load_image(source).mode == "RGB"


def test_sixteen_bits_keep_their_brightness() -> None:
    deep = Image.fromarray((np.arange(256, dtype=np.uint16) * 257).reshape(16, 16))
    pixels = np.asarray(load_image(encoded(deep, "PNG")))
    np.testing.assert_array_equal(pixels[..., 0], np.arange(256).reshape(16, 16))


def test_transparency_lies_on_white() -> None:
    clear = Image.new("RGBA", (4, 4), (255, 0, 0, 0))
    assert np.asarray(load_image(encoded(clear, "PNG"))).min() == 255


def test_palette_transparency_lies_on_white() -> None:
    image = Image.new("P", (4, 4), 0)
    image.putpalette([10, 20, 30] + [0] * 765)
    assert np.asarray(load_image(encoded(image, "PNG", transparency=0))).min() == 255


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_rotation_is_applied(orientation: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    data = encoded(PHOTO, "PNG", exif=exif)
    upright = load_image(data)
    assert np.array_equal(upright, ImageOps.exif_transpose(Image.open(io.BytesIO(data))))
    assert np.array_equal(load_image(upright), upright)


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP"])
def test_broken_exif_spoils_no_photograph(kind: str) -> None:
    assert load_image(encoded(PHOTO, kind, exif=b"Exif\0\0nothing that can be read")).size == (60, 40)
    turned, unwritable = struct.pack(">HHII", 0x0112, 3, 1, 6 << 16), struct.pack(">HHII", 0x010E, 5, 1, 8)
    for count, end in ((2, bytes(4)), (3, b"")):
        exif = b"Exif\0\0MM\0*\0\0\0\x08" + struct.pack(">H", count) + turned + unwritable + end
        assert load_image(encoded(PHOTO, kind, exif=exif)).size == (40, 60)


def test_a_tiff_with_a_tag_too_long_is_read() -> None:
    one, two = struct.pack("<HHI", 0x0112, 3, 1), struct.pack("<HHI", 0x0112, 3, 2)
    data = encoded(PHOTO, "TIFF", tiffinfo={0x0112: 1})
    assert one in data
    assert load_image(data.replace(one, two)).size == (60, 40)


def test_warnings_and_pillows_limit_are_as_they_were_after_many_threads() -> None:
    data = encoded(PHOTO, "TIFF")
    before = (list(warnings.filters), Image.MAX_IMAGE_PIXELS)
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(load_image, [data] * 800))
    assert (warnings.filters, Image.MAX_IMAGE_PIXELS) == before


def test_of_an_animation_the_first_frame() -> None:
    frames = [Image.new("RGB", (8, 8), colour) for colour in ("red", "blue")]
    data = encoded(frames[0], "GIF", save_all=True, append_images=frames[1:])
    assert load_image(data).getpixel((4, 4)) == (255, 0, 0)


def test_one_pixel() -> None:
    assert load_image(Image.new("RGB", (1, 1))).size == (1, 1)


def test_an_image_is_copied_not_shared() -> None:
    image = load_image(PHOTO)
    image.putpixel((0, 0), (1, 2, 3))
    assert np.array_equal(np.asarray(PHOTO), PIXELS)


def test_what_is_not_there_or_not_an_image_says_so(tmp_path: Path) -> None:
    (tmp_path / "empty.jpg").touch()
    (tmp_path / "text.jpg").write_text("not a picture")
    (tmp_path / "cut.jpg").write_bytes(encoded(PHOTO, "JPEG")[:600])
    (tmp_path / "cut.png").write_bytes(encoded(PHOTO, "PNG")[:900])
    for name, words in {
        "none.jpg": "no such image",
        "empty.jpg": "empty file",
        "text.jpg": "not an image",
        "cut.jpg": "damaged or cut off",
        "cut.png": "damaged or cut off",
        ".": "folder",
    }.items():
        with pytest.raises(InputError, match=words) as caught:
            load_image(tmp_path / name)
        assert name.strip(".") in str(caught.value)


def test_the_pixel_limit_names_its_setting() -> None:
    with pytest.raises(InputError, match=r"60 x 40.*image\.max_pixels"):
        load_image(PHOTO, max_pixels=2399)
    assert load_image(PHOTO, max_pixels=2400).size == (60, 40)


def test_a_bomb_is_refused_before_it_is_unpacked() -> None:
    with pytest.raises(InputError, match="max_pixels"):
        load_image(encoded(Image.new("1", (20_000, 20_000)), "PNG"))


def test_a_limit_above_pillows_own_counts() -> None:
    data = encoded(Image.new("1", (20_000, 9_000)), "PNG")
    with pytest.raises(InputError, match=r"20000 x 9000.*image\.max_pixels"):
        load_image(data)
    theirs = Image.MAX_IMAGE_PIXELS
    assert load_image(data, max_pixels=200_000_000).size == (20_000, 9_000)
    assert theirs == Image.MAX_IMAGE_PIXELS


def test_a_damaged_pil_image_is_refused_like_a_file() -> None:
    with pytest.raises(InputError, match="damaged or cut off"):
        load_image(Image.open(io.BytesIO(encoded(PHOTO, "PNG")[:900])))


def test_any_kind_of_path(tmp_path: Path) -> None:
    class Place:
        def __fspath__(self) -> str:
            return str(tmp_path / "photo.png")

    PHOTO.save(tmp_path / "photo.png")
    for source in (tmp_path / "photo.png", str(tmp_path / "photo.png"), Place()):
        assert load_image(source).size == (60, 40)  # type: ignore[arg-type]


@pytest.mark.parametrize("source", [None, 3, [1, 2]])
def test_what_is_no_kind_of_image_is_refused(source: object) -> None:
    with pytest.raises(InputError, match=type(source).__name__):
        load_image(source)  # type: ignore[arg-type]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes with a name are POSIX's")
def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.jpg")
    with pytest.raises(InputError, match="pipe"):
        load_image(tmp_path / "pipe.jpg")


@pytest.mark.parametrize(
    "array",
    [np.zeros((4, 4, 3)), np.zeros((4, 4, 2), np.uint8), np.zeros((3,), np.uint8), np.zeros((0, 4, 3), np.uint8)],
)
def test_arrays_of_another_kind_are_refused(array: np.ndarray) -> None:
    with pytest.raises(InputError, match="array"):
        load_image(array)


@given(st.binary(max_size=400), st.sampled_from(["PNG", "JPEG", "GIF", "TIFF", "WEBP", "BMP"]), st.integers(0, 300))
def test_damaged_bytes_are_read_or_refused(noise: bytes, kind: str, place: int) -> None:
    data = bytearray(encoded(PHOTO.resize((12, 8)), kind))
    data[place : place + len(noise)] = noise
    try:
        assert load_image(bytes(data)).mode == "RGB"
    except InputError as error:
        assert str(error)


@pytest.mark.parametrize("kind", ["EPS", "PCX", "TGA", "JPEG2000", "ICO"])
def test_formats_that_few_test_or_that_start_programs_are_not_decoded(kind: str) -> None:
    with pytest.raises(InputError, match="not an image in a format that can be read"):
        load_image(encoded(PHOTO, kind))


def test_the_hash_is_of_the_pixels_and_the_size() -> None:
    assert image_hash(PHOTO) == image_hash(load_image(encoded(PHOTO, "PNG")))
    assert image_hash(PHOTO) != image_hash(PHOTO.transpose(Image.Transpose.FLIP_TOP_BOTTOM))
    assert image_hash(Image.new("L", (4, 9))) != image_hash(Image.new("L", (9, 4)))


def test_find_images_looks_below_and_leaves_hidden_ones(tmp_path: Path) -> None:
    for name in ("b.JPG", "a.png", "sub/c.webp", ".hidden/d.png", ".e.png", "notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert [path.relative_to(tmp_path).as_posix() for path in find_images(tmp_path)] == ["a.png", "b.JPG", "sub/c.webp"]


def test_find_images_takes_no_answers_for_photographs(tmp_path: Path) -> None:
    answer = ("affordance.json", "mask.png", "overlay.png", "imagination.png")
    for name in ("mug.png", *answer, "out/cup.png", "masks/mask.png", *(f"out/mug/{name}" for name in answer)):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    found = [path.relative_to(tmp_path).as_posix() for path in find_images(tmp_path)]
    assert found == ["masks/mask.png", "mug.png", "out/cup.png"]


def test_a_picture_is_hashed_once_and_forgotten_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    hashed: list[Image.Image] = []
    monkeypatch.setattr(load, "_hash_pixels", lambda image: hashed.append(image) or str(image.getpixel((0, 0))))
    photo = Image.new("RGB", (4, 3), "red")
    assert image_hash(photo) == image_hash(photo)
    assert len(hashed) == 1
    hashed.clear()
    del photo
    gc.collect()
    assert not [name for _, name in load._HASHES.values() if name == "(255, 0, 0)"]
    names = {image_hash(Image.new("RGB", (4, 3), (shade, 0, 0))) for shade in range(200)}
    assert len(names) == 200  # Python gives the id of an object that is gone to the next one
