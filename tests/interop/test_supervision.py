from __future__ import annotations

import numpy as np
import pytest

from a4agent.interop.supervision import to_supervision
from a4agent.types import Affordance, Region, Target

pytest.importorskip("supervision", reason="needs the extra interop")


def region(box: list[float] | None, score: float | None, points: list[list[float]]) -> Region:
    mask = np.zeros((20, 30), bool)
    mask[2:6, 4:9] = True
    return Region(
        None if box is None else np.array(box, np.float32), np.array(points, np.float32).reshape(-1, 2), mask, score
    )


def test_detections_can_be_filtered_and_drawn() -> None:
    import supervision as sv

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
    regions = (region(None, 0.9, []), region(None, None, []))
    assert to_supervision(Affordance("open", (30, 20), regions=regions)).confidence is None


def test_nothing_found_is_no_detection() -> None:
    detections = to_supervision(Affordance("open", (30, 20)))
    assert len(detections) == 0
    assert detections.mask.shape == (0, 20, 30)
    assert len(to_supervision(Affordance("open", (0, 0), status="error"))) == 0
