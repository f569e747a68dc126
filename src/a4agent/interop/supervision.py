"""`supervision.Detections`, for its annotators, filters and metrics.

    detections = to_supervision(affordance)
    picture = sv.MaskAnnotator(color_lookup=sv.ColorLookup.INDEX).annotate(picture, detections)

All regions have the same class, so colour them by index (`ColorLookup.INDEX`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from a4agent.errors import require
from a4agent.types import Affordance


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
