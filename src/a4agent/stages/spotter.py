"""Where: the Spotter finds the named part as boxes and points, and turns them into masks.

    Detector(I, "the handle of the mug") -> boxes, points        Segmenter(I, pairs) -> masks
(arXiv 2512.14442, section 3.4; the authors' pairing rule is `pairing="paper"`.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from a4agent.errors import ConfigError, ProviderError
from a4agent.protocols import Detector, DetectRequest, Segmenter, SegmentRequest
from a4agent.stages import pairing as geometry
from a4agent.stages.pairing import Pairing
from a4agent.stages.recorder import Recorder
from a4agent.types import Detection, Region

if TYPE_CHECKING:
    from PIL.Image import Image


@dataclass(frozen=True)
class Spotter:
    """Locates a phrase with a detector and a segmenter.

    Without a segmenter, the detector's own masks are the answer (models that segment as they detect).
    """

    detector: Detector
    segmenter: Segmenter | None
    pairing: Pairing = "optimal"

    def locate(
        self,
        image: Image,
        phrase: str,
        recorder: Recorder | None = None,
        detection: Detection | None = None,
        on_detection: Callable[[Detection], None] | None = None,
    ) -> tuple[Region, ...]:
        """The regions that show `phrase`, best first as the detector gave them; none found is an empty tuple.

        A `detection` that is given is used instead of asking the detector.

        Raises:
            ProviderError: a model could not be asked, or answered with arrays of the wrong shape.
        """
        recorder = recorder or Recorder()
        if detection is None:
            detection = recorder.ask("spotter", self.detector, DetectRequest(image=image, phrase=phrase))
        detection = _clean(self.detector.id, detection, image.size)
        if on_detection is not None:
            on_detection(detection)
        if self.segmenter is None:
            return _regions_of_masks(self.detector.id, detection, image.size)
        pairs = geometry.pair(detection.boxes_xyxy, detection.points_xy, self.pairing)
        if not pairs:
            return ()
        prompts = geometry.to_prompts(detection.boxes_xyxy, detection.points_xy, self.pairing)
        answer = recorder.ask("spotter", self.segmenter, SegmentRequest(image=image, prompts=prompts))
        masks, predicted_iou = _best(self.segmenter.id, answer.masks, answer.predicted_iou, len(prompts), image.size)
        scores = detection.scores
        return tuple(
            Region(
                box_xyxy=prompt.box_xyxy,
                points_xy=prompt.points_xy,
                mask=mask,
                score=_score(quality if scores is None or box is None else scores[box]),
            )
            for prompt, (box, _), mask, quality in zip(prompts, pairs, masks, predicted_iou, strict=True)
        )


def _score(value: float) -> float | None:
    """A model that has no number for its confidence has no score."""
    return float(value) if np.isfinite(value) else None


def _clean(expert: str, detection: Detection, size_wh: tuple[int, int]) -> Detection:
    """Boxes ordered, clipped and without empty ones, points inside the image; scores and masks follow the boxes."""
    try:
        count = np.size(detection.boxes_xyxy) // 4
        boxes, kept = geometry.clean_boxes(detection.boxes_xyxy, size_wh)
        points = geometry.clean_points(detection.points_xy, size_wh)
        follow: dict[str, Any] = {}
        if detection.scores is not None:
            follow["scores"] = np.asarray(detection.scores, np.float32).reshape(count)[kept]
        if detection.masks is not None:
            masks = np.asarray(detection.masks)
            if len(masks) != count:
                raise ValueError(f"{len(masks)} masks for {count} boxes")
            follow["masks"] = masks[kept]
    except (ValueError, TypeError) as error:
        raise ProviderError(f"{expert} returned boxes, points, scores and masks that do not fit: {error}") from error
    return replace(detection, boxes_xyxy=boxes, points_xy=points, **follow)


def _best(
    expert: str, masks: np.ndarray, predicted_iou: np.ndarray, prompts: int, size_wh: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Of each prompt's candidates the one with the highest predicted IoU: (p, H, W) and (p,)."""
    width, height = size_wh
    if masks.ndim != 4 or masks.shape[0] != prompts or masks.shape[2:] != (height, width):
        raise ProviderError(
            f"{expert} returned masks of shape {masks.shape} for {prompts} prompts on an image of {height} x {width}"
        )
    if predicted_iou.shape != masks.shape[:2]:
        raise ProviderError(f"{expert} returned predicted IoU of shape {predicted_iou.shape} for masks {masks.shape}")
    best = np.nan_to_num(predicted_iou, nan=-np.inf).argmax(1)
    rows = np.arange(prompts)
    return masks[rows, best].astype(bool, copy=False), predicted_iou[rows, best]


def _regions_of_masks(expert: str, detection: Detection, size_wh: tuple[int, int]) -> tuple[Region, ...]:
    """Each box with the detector's own mask and the points that lie in that mask."""
    if not len(detection.boxes_xyxy):
        return ()
    if detection.masks is None:
        raise ConfigError(f"{expert} gives boxes and no masks; set spotter.segmenter (for instance 'sam2:tiny')")
    width, height = size_wh
    if detection.masks.shape[1:] != (height, width):
        raise ProviderError(
            f"{expert} returned masks of {detection.masks.shape[1:]} for an image of {height} x {width}"
        )
    columns, rows = detection.points_xy.astype(int).T if len(detection.points_xy) else np.zeros((2, 0), int)
    scores = detection.scores
    return tuple(
        Region(
            box_xyxy=box,
            points_xy=detection.points_xy[mask[rows, columns]],
            mask=mask.astype(bool, copy=False),
            score=None if scores is None else _score(scores[i]),
        )
        for i, (box, mask) in enumerate(zip(detection.boxes_xyxy, detection.masks, strict=True))
    )
