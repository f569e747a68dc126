"""The regions of an answer as COCO annotations and as `supervision.Detections`.

    to_coco(affordance, image_id=1)
        -> [{"id": 1, "image_id": 1, "category_id": 1, "bbox": [402.0, 180.0, 69.0, 142.0], "area": 6120,
             "segmentation": {"size": [480, 640], "counts": "..."}, "iscrowd": 0, "score": 0.93,
             "keypoints": [440.0, 251.0, 2], "num_keypoints": 1}]

    sv.MaskAnnotator(color_lookup=sv.ColorLookup.INDEX).annotate(picture, to_supervision(affordance))

All regions have the same class, so colour them by index.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from a4agent.errors import require
from a4agent.imaging.masks import encode_rle
from a4agent.types import Affordance

VISIBLE = 2


def to_coco(
    affordance: Affordance, *, image_id: int = 1, category_id: int = 1, first_id: int = 1
) -> list[dict[str, Any]]:
    """The regions as COCO annotations, best first, JSON-safe; no region gives an empty list.

    A region without a box gets the tight box around its mask; one without a score has no `score`.
    """
    annotations: list[dict[str, Any]] = []
    for number, region in enumerate(affordance.regions):
        box = region.any_box_xyxy
        x0, y0, x1, y1 = [0.0] * 4 if box is None else map(float, box)
        points = np.round(region.points_xy.reshape(-1, 2).astype(np.float64), 2)
        annotation: dict[str, Any] = {
            "id": first_id + number,
            "image_id": image_id,
            "category_id": category_id,
            "bbox": [round(value, 2) for value in (x0, y0, x1 - x0, y1 - y0)],
            "area": int(region.mask.sum()),
            "segmentation": encode_rle(region.mask),
            "iscrowd": 0,
            "keypoints": [value for x, y in points.tolist() for value in (x, y, VISIBLE)],
            "num_keypoints": len(points),
        }
        if region.score is not None:
            annotation["score"] = float(region.score)
        annotations.append(annotation)
    return annotations


def to_supervision(affordance: Affordance) -> Any:
    """The regions as `supervision.Detections`: xyxy (n, 4), mask (n, H, W), class 0, and its name under `data`.

    A region without a box has the tight box around its mask. `confidence` is None unless every region has a score,
    since supervision does not support missing ones. Key points are in `data["points_xy"]`, an object array of (k, 2).

    Raises:
        MissingExtraError: supervision is not installed.
    """
    sv = require("supervision", extra="interop")
    regions = affordance.regions
    width, height = affordance.size_wh
    boxes = [np.zeros(4) if region.any_box_xyxy is None else region.any_box_xyxy for region in regions]
    points = np.empty(len(regions), dtype=object)
    points[:] = [region.points_xy for region in regions]
    scores = [region.score for region in regions if region.score is not None]
    return sv.Detections(
        xyxy=np.array(boxes, np.float32).reshape(-1, 4),
        mask=np.array([region.mask for region in regions], bool).reshape(len(regions), height, width),
        confidence=np.array(scores, np.float32) if len(scores) == len(regions) else None,
        class_id=np.zeros(len(regions), int),
        data={"class_name": np.full(len(regions), affordance.phrase), "points_xy": points},
    )
