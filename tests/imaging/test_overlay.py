"""The overlay: it shows the mask, on light and dark, and survives every odd picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from a4agent import Affordance, Region, Target
from a4agent.imaging import overlay
from a4agent.imaging.load import load_image
from a4agent.imaging.overlay import _font


def answer(width: int, height: int, box: tuple[int, int, int, int] | None, part: str = "the handle") -> Affordance:
    mask = np.zeros((height, width), bool)
    regions = ()
    if box is not None:
        x0, y0, x1, y1 = box
        mask[y0:y1, x0:x1] = True
        regions = (Region(np.array(box, np.float32), np.array([[(x0 + x1) / 2, (y0 + y1) / 2]], np.float32), mask),)
    return Affordance("x", (width, height), None, Target("x", "mug", part), regions, "ok" if regions else "empty")


def draw(photo: Image.Image, seen: Affordance) -> Image.Image:
    return replace(seen, image=photo).draw()


@pytest.mark.parametrize("ground", ["white", "black", "grey"])
def test_the_region_stands_out_from_any_ground(ground: str) -> None:
    photo = Image.new("RGB", (800, 600), ground)
    drawn = np.asarray(draw(photo, answer(800, 600, (200, 200, 400, 300))), np.int16)
    plain = np.asarray(photo, np.int16)
    inside, outline = drawn[220:230, 220:380], drawn[198:204, 250:350]
    assert np.abs(inside - plain[0, 0]).max(-1).mean() > 40
    assert outline.max() - outline.min() > 120


@pytest.mark.parametrize("size", [(1, 1), (1, 500), (500, 1), (7, 5), (3000, 40), (4000, 3000)])
def test_any_size(size: tuple[int, int]) -> None:
    drawn = draw(Image.new("RGB", size), answer(*size, box=(0, 0, *size)))
    assert max(drawn.size) <= 1600
    assert draw(Image.new("RGB", size), answer(*size, box=None)).mode == "RGB"


def test_the_caption_says_what_happened() -> None:
    assert answer(9, 9, (1, 1, 3, 3)).summary == "the handle"
    assert answer(9, 9, None).summary == "not found: the handle"
    assert Affordance("x", (9, 9), status="error", error="no\nserver").summary == "error: no\nserver"


@pytest.mark.parametrize("part", ["the handle of the mug " * 30, "ручка кружки", "冰箱的把手", "", "\n\t"])
def test_any_caption(part: str) -> None:
    draw(Image.new("RGB", (300, 200)), answer(300, 200, (10, 10, 60, 60), part))


def test_a_very_long_caption_takes_no_longer() -> None:
    draw(Image.new("RGB", (300, 200)), answer(300, 200, None, "x" * 1_000_000))


def test_letters_without_a_shape_become_an_ellipsis() -> None:
    font, text = _font("the \U0010fffe\U0010fffd mug", 20)
    assert text == "the … mug"
    assert font.getlength(text)


def test_without_fonts_for_a_script_the_rest_is_still_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(overlay, "FONTS", ("none-of-this-name.ttf",))
    assert _font("the 把手 of the mug", 20)[1] == "the … of the mug"
    draw(Image.new("RGB", (300, 200)), answer(300, 200, None, "把手"))


def test_a_picture_over_the_usual_limit_can_be_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(load_image.__kwdefaults__, "max_pixels", 100)
    assert draw(Image.new("RGB", (30, 20)), answer(30, 20, None)).width == 640


def test_an_answer_is_saved_whole_and_read_back(tmp_path: Path) -> None:
    photo = Image.new("RGB", (64, 48))
    affordance = replace(answer(64, 48, (4, 4, 20, 20)), image=photo)
    folder = affordance.save(tmp_path / "a" / "b")
    assert sorted(path.name for path in folder.iterdir()) == ["affordance.json", "mask.png", "overlay.png"]
    np.testing.assert_array_equal(np.asarray(load_image(folder / "mask.png"))[..., 0] > 0, affordance.mask)
    assert Affordance.load(folder).to_dict() == affordance.to_dict()


def test_an_unsure_answer_is_hatched() -> None:
    """Some pixels of the mask keep their colour, and its outline is drawn all the same."""
    sure = replace(answer(640, 480, (100, 100, 300, 300)), image=Image.new("RGB", (640, 480), "grey"))
    unsure = replace(sure, status="abstained", confidence=0.3)
    tinted, hatched = (np.asarray(each.draw(caption=False))[110:180, 110:180].reshape(-1, 3) for each in (sure, unsure))
    assert len(np.unique(tinted, axis=0)) == 1
    kept = (hatched == 128).all(1).mean()
    assert 0.5 < kept < 0.8
    outline = [np.asarray(each.draw(caption=False))[97:103, 200].astype(int) for each in (sure, unsure)]
    assert np.abs(outline[0] - outline[1]).max() < 10
