"""`offline:parts` as a detector: the box and the innermost point of the part that a phrase names.

`scores` is how likely the thing is of the kind that was named: low when the picture shows no such thing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from a4agent.errors import A4Error
from a4agent.imaging.masks import deepest_point, tight_box
from a4agent.offline import revision
from a4agent.offline.choice import choose
from a4agent.offline.eye import forget, look, look_closer
from a4agent.offline.phrases import wanted
from a4agent.protocols import DetectRequest, ExpertBase
from a4agent.types import Detection


class OfflineDetector(ExpertBase):
    """A Detector of one box and one point; none where the network sees no thing."""

    def __init__(self, *, threads: int = 0) -> None:
        super().__init__("offline:parts", revision=revision())
        self.threads = threads

    def detect(self, requests: Sequence[DetectRequest]) -> list[Detection | A4Error]:
        return [self._detect(request) for request in requests]

    def _detect(self, request: DetectRequest) -> Detection:
        choice = choose(wanted(request.phrase), look(request.image, self.threads))
        if choice is None:
            return Detection(text="no thing stands out from the background")
        mask = look_closer(choice.thing, choice.region, self.threads)
        box, point = tight_box(mask), deepest_point(mask & choice.thing.mask)
        if box is None or point is None:
            return Detection(text="no thing stands out from the background")
        return Detection(
            boxes_xyxy=box[None],
            points_xy=point[None],
            scores=None if choice.match is None else np.array([choice.match], np.float32),
            text=f"{request.phrase!r} in a thing that looks like: {choice.thing.likeliest[0]}",
        )

    def close(self) -> None:
        forget()
