"""What detectors of the DETR kind share: a phrase and an image in, many scored boxes out, the good ones kept.

keep = best_boxes(boxes_xyxy, scores, threshold=0.3, nms_iou=0.5, max_boxes=20)     # indices, best first
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from a4agent.errors import A4Error, ConfigError, require
from a4agent.experts.local.base import LocalExpert, Placement, Stopwatch, load_pretrained
from a4agent.experts.local.checkpoints import Checkpoint
from a4agent.experts.local.generation import load_processor
from a4agent.protocols import DetectRequest
from a4agent.types import Detection


@dataclass(frozen=True)
class BoxSelection:
    """Which boxes are kept: score above `threshold`, at most `nms_iou` over a better one, the `max_boxes` best."""

    threshold: float
    nms_iou: float
    max_boxes: int

    def __post_init__(self) -> None:
        if not (0 <= self.threshold < 1 and 0 < self.nms_iou <= 1 and self.max_boxes >= 1):
            raise ConfigError(
                f"threshold must be in [0, 1), nms_iou in (0, 1] (1: off) and max_boxes at least 1, not {self}"
            )


@dataclass(frozen=True, eq=False)
class Candidates:
    """All boxes of one image: `boxes_xyxy` (n, 4) in pixels, `scores` (n,), `points_xy` (n, 2), one for each box."""

    boxes_xyxy: np.ndarray
    scores: np.ndarray
    points_xy: np.ndarray


class OpenVocabularyDetector(LocalExpert):
    """A detector that scores boxes. A subclass prepares the inputs and reads the output."""

    model_class = ""

    def __init__(
        self, id: str, checkpoint: Checkpoint, placement: Placement, selection: BoxSelection, max_batch: int = 4
    ) -> None:
        super().__init__(id, checkpoint, placement, settings=vars(selection), max_batch=max_batch)
        self._selection = selection
        self._model: Any = None
        self._processor: Any = None

    def detect(self, requests: Sequence[DetectRequest]) -> list[Detection | A4Error]:
        """Boxes with scores, best first; the points are derived from the boxes, one for each.

        Raises:
            ResourceError: the weights do not fit.
            ProviderError: the model failed.
        """
        # Images of other sizes would be padded, and padding changes the boxes.
        return self._in_batches(requests, self._answer, alike=lambda request: request.image.size)

    def inputs_of(self, requests: Sequence[DetectRequest]) -> Any:
        """The processor's batch for these requests."""
        raise NotImplementedError

    def candidates_of(self, output: Any, k: int, size_wh: tuple[int, int]) -> Candidates:
        """The k-th image's boxes in the model's output."""
        raise NotImplementedError

    def _load(self) -> None:
        transformers: Any = require("transformers", extra="local")
        self._processor = load_processor(self.checkpoint.folder)
        self._model = load_pretrained(getattr(transformers, self.model_class), self.checkpoint, self.placement)

    def _unload(self) -> None:
        self._model = self._processor = None

    def _answer(self, requests: Sequence[DetectRequest]) -> list[Detection]:
        watch = Stopwatch()
        inputs = self.inputs_of(requests).to(self._model.device, dtype=self._model.dtype)
        output = self._model(**inputs)
        detections: list[Detection] = []
        for k, request in enumerate(requests):
            found = self.candidates_of(output, k, request.image.size)
            keep = best_boxes(found.boxes_xyxy, found.scores, **vars(self._selection))
            detections.append(
                Detection(
                    boxes_xyxy=found.boxes_xyxy[keep].astype(np.float32),
                    points_xy=found.points_xy[keep].astype(np.float32),
                    scores=found.scores[keep].astype(np.float32),
                    points_derived=True,
                    usage=watch.usage(len(requests)),
                )
            )
        return detections


def to_corners(boxes_cxcywh: np.ndarray) -> np.ndarray:
    """(n, 4) centre x, centre y, width, height -> x0, y0, x1, y1."""
    centre, half = boxes_cxcywh[:, :2], boxes_cxcywh[:, 2:] / 2
    return np.concatenate([centre - half, centre + half], axis=1)


def centres(boxes_xyxy: np.ndarray) -> np.ndarray:
    """(n, 2) middles of boxes."""
    return (boxes_xyxy[:, :2] + boxes_xyxy[:, 2:]) / 2


def best_boxes(
    boxes_xyxy: np.ndarray, scores: np.ndarray, threshold: float, nms_iou: float, max_boxes: int
) -> np.ndarray:
    """The indices of the boxes to keep, best first; of two that overlap by more than `nms_iou` the better one."""
    kept: list[int] = []
    for k in np.argsort(-scores, kind="stable"):
        if len(kept) == max_boxes or not scores[k] > threshold:
            break
        if nms_iou >= 1 or not kept or _iou(boxes_xyxy[k], boxes_xyxy[kept]).max() <= nms_iou:
            kept.append(int(k))
    return np.array(kept, int)


def _iou(box: np.ndarray, others: np.ndarray) -> np.ndarray:
    low, high = np.maximum(box[:2], others[:, :2]), np.minimum(box[2:], others[:, 2:])
    overlap = np.clip(high - low, 0, None).prod(1)
    area = (box[2:] - box[:2]).prod() + (others[:, 2:] - others[:, :2]).prod(1) - overlap
    return overlap / np.maximum(area, 1e-9)
