"""Other systems' masks: PNG by id, COCO RLE by id, what is missing and what is for nobody."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from a4agent.benchmarks.predictions import Predictions
from a4agent.errors import DataError
from a4agent.imaging.masks import encode_rle
from layouts import boxed, mask

ONE, TWO = boxed((0, 0, 3, 3)), boxed((5, 5, 9, 8))


def test_pictures_by_id_also_below_folders_and_with_dots(tmp_path: Path) -> None:
    for identity in ("plain", "a.b.c", "folder/one"):
        mask(tmp_path / f"{identity}.png", (0, 0, 3, 3))

    predictions = Predictions(tmp_path)

    for identity in ("plain", "a.b.c", "folder/one"):
        assert np.array_equal(predictions.mask(identity), ONE)
    assert predictions.mask("other") is None
    assert predictions.strays(["plain", "a.b.c"]) == ["folder/one"]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("p.json", json.dumps({"x": encode_rle(ONE), "y": [encode_rle(ONE), encode_rle(TWO)], "z": None, "e": []})),
        (
            "p.json",
            json.dumps(
                [
                    {"id": identity, "mask": value}
                    for identity, value in (
                        ("x", encode_rle(ONE)),
                        ("y", encode_rle(TWO)),
                        ("y", encode_rle(ONE)),
                        ("z", None),
                    )
                ]
            ),
        ),
        (
            "p.jsonl",
            "\n".join(
                json.dumps({"id": identity, "mask": value})
                for identity, value in (("x", encode_rle(ONE)), ("y", [encode_rle(ONE), encode_rle(TWO)]), ("z", None))
            ),
        ),
    ],
)
def test_rle_by_id_in_a_folder_or_alone(tmp_path: Path, name: str, content: str) -> None:
    (tmp_path / name).write_text(content)

    for predictions in (Predictions(tmp_path), Predictions(tmp_path / name)):
        assert np.array_equal(predictions.mask("x"), ONE)
        assert np.array_equal(predictions.mask("y"), ONE | TWO)
        assert predictions.mask("z") is None
        assert predictions.strays(["x", "y", "z", "e"]) == []


def test_an_id_cannot_reach_outside_the_folder(tmp_path: Path) -> None:
    mask(tmp_path / "secret.png", (0, 0, 3, 3))
    (tmp_path / "predictions").mkdir()

    assert Predictions(tmp_path / "predictions").mask("../secret") is None


@pytest.mark.parametrize("content", ["3", "[3]", '[{"id": "x"}]', '{"x": "text"}', '{"x": [4]}', "{"])
def test_a_file_of_another_form_is_named(tmp_path: Path, content: str) -> None:
    (tmp_path / "p.json").write_text(content)

    with pytest.raises(DataError, match=r"p\.json"):
        Predictions(tmp_path)


@pytest.mark.parametrize(
    "value", [{"size": [8, 12]}, {"size": [8, 12], "counts": [500, 1]}, {"size": [-1, 2], "counts": ""}]
)
def test_a_mask_that_cannot_be_read_is_an_error_for_its_sample_alone(tmp_path: Path, value: dict[str, Any]) -> None:
    (tmp_path / "p.json").write_text(json.dumps({"bad": value, "good": encode_rle(ONE)}))
    predictions = Predictions(tmp_path)

    with pytest.raises(DataError, match="'bad'"):
        predictions.mask("bad")
    assert np.array_equal(predictions.mask("good"), ONE)


def test_masks_of_one_id_and_two_sizes(tmp_path: Path) -> None:
    (tmp_path / "p.json").write_text(json.dumps({"x": [encode_rle(ONE), encode_rle(np.zeros((2, 2), bool))]}))

    with pytest.raises(DataError, match="different sizes"):
        Predictions(tmp_path).mask("x")


def test_nothing_there(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no predictions"):
        Predictions(tmp_path / "nowhere")
