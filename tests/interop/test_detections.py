from __future__ import annotations

import json

import numpy as np
import pytest

from a4agent.imaging.masks import decode_rle
from a4agent.interop.detections import to_coco, to_supervision
from a4agent.types import Affordance, Region, Target


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


def region(box: list[float] | None, score: float | None, points: list[list[float]]) -> Region:
    mask = np.zeros((20, 30), bool)
    mask[2:6, 4:9] = True
    return Region(
        None if box is None else np.array(box, np.float32), np.array(points, np.float32).reshape(-1, 2), mask, score
    )


def test_detections_can_be_filtered_and_drawn() -> None:
    sv = pytest.importorskip("supervision", reason="needs the extra interop")

    target = Target("t", "drawer", "the handle of the drawer")
    regions = (region([4, 2, 9, 6], 0.9, [[6, 3]]), region(None, 0.4, [[6, 3], [7, 4]]))
    detections = to_supervision(Affordance("open", (30, 20), target=target, regions=regions))
    assert detections.xyxy.tolist() == [[4, 2, 9, 6], [4, 2, 9, 6]]
    assert detections.data["class_name"].tolist() == ["the handle of the drawer"] * 2
    confident = detections[detections.confidence > 0.5]
    assert len(confident) == 1
    assert confident.data["points_xy"][0].tolist() == [[6, 3]]
    drawn = sv.MaskAnnotator(color_lookup=sv.ColorLookup.INDEX).annotate(np.zeros((20, 30, 3), np.uint8), detections)
    assert (drawn.any(2) == regions[0].mask).all()


def test_one_missing_score_means_no_confidence() -> None:
    pytest.importorskip("supervision", reason="needs the extra interop")
    regions = (region(None, 0.9, []), region(None, None, []))
    assert to_supervision(Affordance("open", (30, 20), regions=regions)).confidence is None


def test_nothing_found_is_an_empty_detection() -> None:
    pytest.importorskip("supervision", reason="needs the extra interop")
    detections = to_supervision(Affordance("open", (30, 20)))
    assert len(detections) == 0
    assert detections.mask.shape == (0, 20, 30)
    assert len(to_supervision(Affordance("open", (0, 0), status="error"))) == 0
