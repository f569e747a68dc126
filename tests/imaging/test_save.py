"""Writing answers where they can and cannot be written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from a4agent import Affordance, Imagination
from a4agent import files as folders
from a4agent.errors import DataError, InputError
from a4agent.imaging.load import load_image
from a4agent.imaging.save import make_folder

EMPTY = Affordance("open it", (8, 6), status="empty")


def test_the_imagination_is_saved_when_there_is_one(tmp_path: Path) -> None:
    dreamt = replace(EMPTY, imagination=Imagination("Edit it.", Image.new("RGB", (5, 5), "red")))
    dreamt.save(tmp_path)
    assert load_image(tmp_path / "imagination.png").size == (5, 5)
    imagination = Affordance.load(tmp_path).imagination
    assert imagination is not None
    assert imagination.prompt == "Edit it."


def test_a_failed_sample_without_a_size_is_saved_too(tmp_path: Path) -> None:
    Affordance("open it", (0, 0), status="error", error="no such image").save(tmp_path)
    assert Affordance.load(tmp_path).error == "no such image"
    assert not (tmp_path / "mask.png").exists()


def test_a_folder_that_is_a_file_is_an_error_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "out").touch()
    for folder in (tmp_path / "out", tmp_path / "out" / "mug"):
        with pytest.raises(InputError, match=r"out.*--out"):
            make_folder(folder)
        with pytest.raises(InputError, match=r"out.*--out"):
            EMPTY.save(folder)


def test_saving_anew_leaves_nothing_of_the_answer_before(tmp_path: Path) -> None:
    photo = Image.new("RGB", (8, 6))
    replace(EMPTY, image=photo, imagination=Imagination("Edit it.", photo)).save(tmp_path)
    (tmp_path / "notes.txt").touch()
    replace(EMPTY, image=photo).save(tmp_path)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["affordance.json", "mask.png", "notes.txt", "overlay.png"]
    Affordance("open it", (0, 0), status="error", error="no such image").save(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["affordance.json", "notes.txt"]


def test_a_failed_write_keeps_the_old_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    EMPTY.save(tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def full(draft: Path, path: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(folders.os, "replace", full)
    with pytest.raises(InputError, match="No space left"):
        replace(EMPTY, size_wh=(3, 3)).save(tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_an_imagined_picture_of_any_mode_is_saved(tmp_path: Path) -> None:
    replace(EMPTY, imagination=Imagination("Edit it.", Image.new("CMYK", (8, 6)))).save(tmp_path)
    assert load_image(tmp_path / "imagination.png").size == (8, 6)


def test_a_name_that_is_not_unicode_is_saved_and_read_back(tmp_path: Path) -> None:
    name = "caf\udce9"  # how Python shows the bytes of a file name that is not UTF-8
    assert Affordance.load(replace(EMPTY, id=name, instruction="开门").save(tmp_path)).id == name
    assert "开门" in (tmp_path / "affordance.json").read_text(encoding="utf-8")


def test_loading_a_missing_or_invalid_answer(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"affordance\.json"):
        Affordance.load(tmp_path)
    for text in (b'{"schema": 2}', b"[]", b"{", b"\xff"):
        (tmp_path / "affordance.json").write_bytes(text)
        with pytest.raises(DataError, match=r"affordance\.json"):
            Affordance.load(tmp_path)


def test_masks_are_the_size_of_the_image(tmp_path: Path) -> None:
    EMPTY.save(tmp_path)
    assert load_image(tmp_path / "mask.png").size == (8, 6)
