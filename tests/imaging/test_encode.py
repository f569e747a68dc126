"""Pictures for the wire: equal pictures are equal bytes, and a picture is encoded once."""

from __future__ import annotations

import base64
import gc
import io
import threading

import numpy as np
import pytest
from PIL import Image

from a4agent.errors import ConfigError
from a4agent.imaging.encode import PictureEncoder

PIXELS = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)


def photo() -> Image.Image:
    return Image.fromarray(PIXELS)


@pytest.mark.parametrize("image_format", ["png", "jpeg"])
def test_equal_pictures_are_equal_bytes_whoever_encodes_them(image_format):
    assert PictureEncoder(image_format).encode(photo()) == PictureEncoder(image_format).encode(photo())


def test_png_keeps_every_pixel():
    encoder = PictureEncoder("png")
    kind, _, data = encoder.data_url(photo()).partition(",")
    assert kind == "data:image/png;base64"
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(base64.b64decode(data)))), PIXELS)


def test_a_picture_is_encoded_once_while_it_lives(monkeypatch):
    saved = []
    save = Image.Image.save
    monkeypatch.setattr(Image.Image, "save", lambda self, *a, **k: (saved.append(self.size), save(self, *a, **k))[1])
    encoder, image = PictureEncoder(), photo()
    first = [encoder.encode(image) for _ in range(3)]
    assert len(set(first)) == len(saved) == 1
    del image
    gc.collect()
    assert not encoder._kept  # what nobody holds any more is forgotten


@pytest.mark.parametrize(("max_side", "size"), [(0, (64, 48)), (64, (64, 48)), (32, (32, 24))])
def test_long_pictures_are_shrunk_and_the_callers_left_alone(max_side, size):
    image = photo()
    assert Image.open(io.BytesIO(PictureEncoder("png", max_side).encode(image))).size == size
    assert image.size == (64, 48)


def test_threads_get_the_same_bytes():
    encoder, image, seen = PictureEncoder(), photo(), set()
    threads = [threading.Thread(target=lambda: seen.add(encoder.encode(image))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(seen) == 1


def test_settings_that_change_the_bytes_are_told():
    assert PictureEncoder("jpeg", 100, 80).settings == {"image_format": "jpeg", "max_side": 100, "quality": 80}
    assert "quality" not in PictureEncoder("png").settings


@pytest.mark.parametrize("settings", [("gif",), ("png", -1), ("jpeg", 0, 0), ("jpeg", 0, 101)])
def test_settings_that_do_not_fit_are_answered(settings):
    with pytest.raises(ConfigError):
        PictureEncoder(*settings)
