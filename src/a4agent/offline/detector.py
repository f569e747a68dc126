"""`offline:parts` as a detector: the box and the innermost point of the part that a phrase names.

It finds one object, the main one, and one part of it. There is no recognition: a phrase about something
that is not in the picture still gets the nearest thing to it.
"""

from __future__ import annotations

from collections.abc import Sequence

from a4agent.errors import A4Error
from a4agent.offline.phrases import wanted
from a4agent.offline.revision import revision
from a4agent.offline.scene import forget, scene_of
from a4agent.protocols import DetectRequest, ExpertBase
from a4agent.types import Detection


class OfflineDetector(ExpertBase):
    """A Detector of one box and one point; none where nothing stands out from the background."""

    def __init__(self, *, threads: int = 0) -> None:
        super().__init__("offline:parts", revision=revision())
        self.threads = threads

    def detect(self, requests: Sequence[DetectRequest]) -> list[Detection | A4Error]:
        return [self._detect(request) for request in requests]

    def _detect(self, request: DetectRequest) -> Detection:
        scene = scene_of(request.image, self.threads)
        what = wanted(request.phrase)
        region = scene.region(what)
        if region is None:
            return Detection(text="nothing stands out from the background")
        return Detection(
            boxes_xyxy=scene.box_xyxy(region)[None],
            points_xy=scene.point_xy(region)[None],
            text=f"{request.phrase!r} read as {what.shape!r}",
        )

    def close(self) -> None:
        forget()
