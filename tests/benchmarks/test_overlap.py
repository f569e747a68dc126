"""Shared pictures are found after what happens to pictures, and different ones are kept apart."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageEnhance, ImageFilter

from a4agent.benchmarks.overlap import hash_images, perceptual_hash, shared
from a4agent.cli.main import main

ROOT = Path(__file__).parents[2]
PHOTO = Image.open(ROOT / "examples" / "coffee.jpg").convert("RGB")


def recompressed(image: Image.Image) -> Image.Image:
    file = io.BytesIO()
    image.save(file, "JPEG", quality=30)
    return Image.open(file).convert("RGB")


def distance(a: Image.Image, b: Image.Image) -> int:
    return (perceptual_hash(a) ^ perceptual_hash(b)).bit_count()


@pytest.mark.parametrize(
    "change",
    [
        recompressed,
        lambda image: image.resize((image.width // 3, image.height // 3)),
        lambda image: image.filter(ImageFilter.GaussianBlur(2)),
        lambda image: ImageEnhance.Brightness(image).enhance(1.3),
        lambda image: image.convert("L").convert("RGB"),
    ],
)
def test_the_same_picture_is_found_again(change) -> None:
    assert distance(PHOTO, change(PHOTO)) <= 6


def test_other_pictures_are_far_away() -> None:
    others = sorted((ROOT / "examples" / "sim" / "images").glob("*.jpg"))
    assert all(distance(PHOTO, Image.open(path)) > 12 for path in others)


def test_pairs_are_sorted_and_broken_files_are_named() -> None:
    noise = Image.fromarray(np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8).astype(np.uint8))
    left, problems = hash_images([("a", PHOTO), ("n", noise), ("x", b"broken")])
    right, _ = hash_images([("b", recompressed(PHOTO)), ("c", PHOTO)])
    first = shared(left, right)[0]
    assert (first.left, first.distance) == ("a", 0)
    assert {pair.left for pair in shared(left, right)} == {"a"}
    assert len(problems) == 1
    assert problems[0].startswith("x: ")
    assert shared({}, right) == []


def test_the_command_counts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recompressed(PHOTO).save(tmp_path / "copy.png")
    with pytest.raises(SystemExit) as ended:
        main(["data", "overlap", f"folder={ROOT / 'examples'}", str(tmp_path)])
    assert ended.value.code == 0
    assert "1 of 5 images" in capsys.readouterr().out
    with pytest.raises(SystemExit) as ended:
        main(["data", "overlap", "nowhere", str(tmp_path)])
    assert ended.value.code == 2
