from __future__ import annotations

import json

import numpy as np
import pytest

from a4agent.imaging.masks import decode_rle
from a4agent.interop.coco import to_coco
from a4agent.types import Affordance, Region

# pycocotools 2.0.11 makes arrays in a way that numpy 2 warns of.
pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation doesn't accept:DeprecationWarning")


def regions() -> tuple[Region, ...]:
    handle, knob = np.zeros((20, 30), bool), np.zeros((20, 30), bool)
    handle[2:6, 4:9] = True
    knob[10:12, 20:23] = True
    return (
        Region(np.array([4, 2, 9, 6], np.float32), np.array([[6.5, 3.5]], np.float32), handle, 0.9),
        Region(None, np.zeros((0, 2), np.float32), knob, None),
    )


def test_annotations_are_what_the_coco_tools_read(capsys: pytest.CaptureFixture[str]) -> None:
    from pycocotools.coco import COCO

    annotations = to_coco(Affordance("x", (30, 20), regions=regions()), image_id=7, category_id=3)
    dataset = COCO()
    dataset.dataset = {
        "images": [{"id": 7, "width": 30, "height": 20}],
        "categories": [{"id": 3, "name": "handle"}],
        "annotations": json.loads(json.dumps(annotations)),
    }
    dataset.createIndex()
    capsys.readouterr()
    first, second = dataset.loadAnns(dataset.getAnnIds(imgIds=[7], catIds=[3]))
    assert first["bbox"] == [4, 2, 5, 4]
    assert second["bbox"] == [20, 10, 3, 2]  # the tight box, where the region had none
    assert (dataset.annToMask(first).astype(bool) == regions()[0].mask).all()
    assert first["area"] == 20
    assert first["keypoints"] == [6.5, 3.5, 2]
    assert first["num_keypoints"] == 1
    assert first["score"] == pytest.approx(0.9)
    assert "score" not in second
    assert [first["id"], second["id"]] == [1, 2]


def test_numbers_go_on_over_many_images() -> None:
    annotations = to_coco(Affordance("x", (30, 20), regions=regions()), first_id=41)
    assert [row["id"] for row in annotations] == [41, 42]


def test_a_blank_mask_has_an_empty_box() -> None:
    blank = Region(None, np.zeros((0, 2), np.float32), np.zeros((20, 30), bool))
    (row,) = to_coco(Affordance("x", (30, 20), regions=(blank,)))
    assert row["bbox"] == [0, 0, 0, 0]
    assert row["area"] == 0
    assert not decode_rle(row["segmentation"]).any()


def test_nothing_found_is_an_empty_list() -> None:
    assert to_coco(Affordance("x", (30, 20))) == []
