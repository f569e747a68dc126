"""Where: the Spotter finds the named part as boxes and points, and turns them into masks.

    Detector(I, "the handle of the mug") -> boxes, points        Segmenter(I, pairs) -> masks
(arXiv 2512.14442, section 3.4; the authors' pairing rule is `pairing="paper"`.)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from PIL.Image import Image

from a4agent.errors import ConfigError, ProviderError
from a4agent.imaging.masks import deepest_point
from a4agent.protocols import Detector, DetectRequest, Prompt, Segmenter, SegmentRequest
from a4agent.stages.pairing import Pairing, clean_boxes, clean_points, to_prompts
from a4agent.stages.recorder import Recorder
from a4agent.types import Detection, Region, finite_or_none, no_points


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
        stage: str = "spotter",
    ) -> tuple[Region, ...]:
        """The regions that show `phrase`, in the detector's order; empty if there is none.

        A `detection` that is given is used instead of asking the detector. `stage` is what the trace calls the asker.

        Raises:
            ProviderError: a model could not be asked, or answered with arrays of the wrong shape.
        """
        recorder = recorder or Recorder()
        if detection is None:
            detection = recorder.ask(stage, self.detector, DetectRequest(image=image, phrase=phrase))
        clean = _clean(self.detector.id, detection, image.size)
        if on_detection is not None:
            on_detection(clean)
        if self.segmenter is None:
            return _regions_of_masks(self.detector.id, clean, image.size)
        pairs = to_prompts(detection, image.size, self.pairing)
        if not pairs:
            return ()
        masks, predicted_iou = self._segment(image, tuple(prompt for prompt, _ in pairs), recorder, stage)
        scores = None if detection.scores is None else np.ravel(detection.scores)
        return tuple(
            Region(
                box_xyxy=prompt.box_xyxy,
                points_xy=_key_points(mask) if detection.points_derived else prompt.points_xy,
                mask=mask,
                score=finite_or_none(float(quality if scores is None or box is None else scores[box])),
                predicted_iou=finite_or_none(float(quality)),
            )
            for (prompt, box), mask, quality in zip(pairs, masks, predicted_iou, strict=True)
        )

    def segment_again(
        self, image: Image, regions: Sequence[Region], recorder: Recorder, stage: str = "spotter"
    ) -> tuple[Region, ...]:
        """The same boxes and points with new masks by this Spotter's segmenter.

        Raises:
            ProviderError: the segmenter could not be asked, or answered with arrays of the wrong shape.
        """
        prompted = [region for region in regions if region.box_xyxy is not None or len(region.points_xy)]
        if not prompted or self.segmenter is None:
            return ()
        prompts = tuple(Prompt(region.box_xyxy, region.points_xy) for region in prompted)
        masks, predicted_iou = self._segment(image, prompts, recorder, stage)
        return tuple(
            replace(region, mask=mask, predicted_iou=finite_or_none(float(quality)))
            for region, mask, quality in zip(prompted, masks, predicted_iou, strict=True)
        )

    def _segment(
        self, image: Image, prompts: tuple[Prompt, ...], recorder: Recorder, stage: str
    ) -> tuple[np.ndarray, np.ndarray]:
        assert self.segmenter is not None
        answer = recorder.ask(stage, self.segmenter, SegmentRequest(image=image, prompts=prompts))
        return _best(self.segmenter.id, answer.masks, answer.predicted_iou, len(prompts), image.size)


def _key_points(mask: np.ndarray) -> np.ndarray:
    """Where the model gave no point (k, 2): the one deepest inside the mask."""
    point = deepest_point(mask)
    return no_points() if point is None else point[None]


def _clean(expert: str, detection: Detection, size_wh: tuple[int, int]) -> Detection:
    """The detection with clean boxes and points, and the scores and masks of the boxes that are left."""
    try:
        count = np.size(detection.boxes_xyxy) // 4
        boxes, kept = clean_boxes(detection.boxes_xyxy, size_wh)
        points, _ = clean_points(detection.points_xy, size_wh)
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
    """Each prompt's candidate with the highest predicted IoU: masks (p, H, W) and predicted IoU (p,)."""
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
        raise ConfigError(f"{expert} gives no masks; set spotter.segmenter (for instance 'sam2:tiny')")
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
            score=None if scores is None else finite_or_none(float(scores[i])),
        )
        for i, (box, mask) in enumerate(zip(detection.boxes_xyxy, detection.masks, strict=True))
    )
