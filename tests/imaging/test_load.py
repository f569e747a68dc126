"""Pictures in: every format and every kind of damage."""

from __future__ import annotations

import errno
import gc
import io
import os
import re
import struct
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageOps

import a4agent
from a4agent.errors import InputError, MissingExtraError, ResourceError
from a4agent.imaging import load
from a4agent.imaging.load import find_images, image_hash, load_image, read_pixels

PIXELS = np.random.default_rng(0).integers(0, 255, (40, 60, 3), dtype=np.uint8)
PHOTO = Image.fromarray(PIXELS)


def encoded(image: Image.Image, kind: str, **options: object) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)  # type: ignore[arg-type]
    return buffer.getvalue()


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "MPO", "WEBP", "AVIF", "BMP", "TIFF", "GIF", "PPM"])
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


def test_missing_files_and_other_formats_are_named(tmp_path: Path) -> None:
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
def test_other_types_are_refused(source: object) -> None:
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


def test_pictures_are_decoded_in_one_place() -> None:
    """Every other door would need the same named formats and limits."""
    source = Path(a4agent.__file__).parent
    doors = [
        str(path.relative_to(source))
        for path in source.rglob("*.py")
        if re.search(r"\b(Images?|Pillow|PIL)\.open\(|\bimread\(|\bimdecode\(", path.read_text(encoding="utf-8"))
    ]
    assert doors == [str(Path("imaging") / "load.py")]


def test_postscript_never_starts_a_program() -> None:
    with pytest.raises(InputError, match="not an image"):
        read_pixels(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n%%EOF\n")


def test_a_telephone_picture_is_scaled_down() -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    data = encoded(Image.new("RGB", (800, 600), "red"), "JPEG", exif=exif)
    assert load_image(data, shrink_to=120_000).size == (300, 400)
    assert load_image(data, shrink_to=480_000).size == (600, 800)
    assert load_image(encoded(PHOTO, "PNG"), shrink_to=600).size == (30, 20)
    assert load_image(PHOTO, shrink_to=600).size == (30, 20)
    assert load_image(PIXELS, shrink_to=1).size == (1, 1)
    with pytest.raises(load.TooManyPixels):
        load_image(data, max_pixels=479_999, shrink_to=1000)


def test_shrinking_decodes_no_more_of_a_jpeg_than_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    decoded: list[tuple[int, int]] = []
    upright = load._upright

    def watched(image: Image.Image) -> Image.Image:
        decoded.append(image.size)
        return upright(image)

    monkeypatch.setattr(load, "_upright", watched)
    assert load_image(encoded(Image.new("RGB", (1600, 1200)), "JPEG"), shrink_to=20_000).size == (163, 122)
    assert decoded == [(200, 150)]


def test_a_path_must_lead_into_the_folder(tmp_path: Path) -> None:
    inside, outside = tmp_path / "run" / "m.png", tmp_path / "secret.png"
    inside.parent.mkdir()
    for path in (inside, outside):
        PHOTO.save(path)
    (inside.parent / "link.png").symlink_to(outside)
    assert load_image(inside, inside=inside.parent).size == (60, 40)
    for path in (outside, inside.parent / ".." / "secret.png", inside.parent / "link.png"):
        with pytest.raises(InputError, match="outside the folder"):
            load_image(path, inside=inside.parent)


def test_a_file_of_many_bytes_is_not_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(load, "MAX_BYTES", 100)
    with pytest.raises(InputError, match="over the limit of 0 MB"):
        load_image(encoded(PHOTO, "PNG"))


@pytest.mark.parametrize(
    ("mode", "shape"),
    [("1", (4, 6)), ("L", (4, 6)), ("P", (4, 6)), ("LA", (4, 6)), ("RGB", (4, 6, 3)), ("RGBA", (4, 6, 3))],
)
def test_pixels_are_read_as_they_are_stored(mode: str, shape: tuple[int, ...]) -> None:
    assert read_pixels(encoded(Image.new(mode, (6, 4)), "PNG")).shape == shape


def test_sixteen_bit_numbers_are_read_as_they_are_stored() -> None:
    numbers = np.array([[0, 1, 300, 65535]], np.uint16)
    np.testing.assert_array_equal(read_pixels(encoded(Image.fromarray(numbers), "PNG")), numbers)


HEIC = b"\0\0\0\x18ftypheic" + bytes(80)


def test_heic_without_its_library_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(MissingExtraError, match=r"a4agent\[heif\]"):
        load_image(HEIC)


def test_heic_photographs() -> None:
    pillow_heif = pytest.importorskip("pillow_heif")
    buffer = io.BytesIO()
    pillow_heif.from_pillow(Image.new("RGB", (64, 48), (200, 30, 40))).save(buffer)
    image = load_image(buffer.getvalue())
    assert image.size == (64, 48)
    assert np.abs(np.asarray(image)[24, 32].astype(int) - (200, 30, 40)).max() < 12
    with pytest.raises(InputError, match=r"damaged|cannot be decoded|not an image"):
        load_image(HEIC)


@pytest.mark.parametrize("number", [errno.EMFILE, errno.ENFILE, errno.ENOMEM])
def test_a_process_without_file_handles_does_not_blame_the_picture(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    PHOTO.save(tmp_path / "photo.png")

    def refuse(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    for owner in (Image, Path):
        with monkeypatch.context() as broken:
            broken.setattr(owner, "open", refuse)
            with pytest.raises(ResourceError, match="ulimit -n") as told:
                load_image(tmp_path / "photo.png")
            assert told.value.fatal
    load_image(tmp_path / "photo.png")
