"""`owlv2:`, `grounding-dino:` and `mm-grounding-dino:` with NAME_OR_FOLDER: scored boxes for a phrase.

    Owlv2("google/owlv2-base-patch16", "detector").detect([DetectRequest(image=photo, phrase="the handle")])
    GroundingDino("IDEA-Research/grounding-dino-tiny", "detector", threshold=0.4)
    best_boxes(boxes_xyxy, scores, threshold=0.3, nms_iou=0.5, max_boxes=20)     # indices, best first

Sources: Minderer et al., OWLv2 (arXiv 2306.09683); Liu et al., Grounding DINO (arXiv 2303.05499).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from a4agent.errors import A4Error, ConfigError, require
from a4agent.experts.coordinates import UNIT, to_pixels
from a4agent.experts.local.base import LocalExpert, Stopwatch, load_pretrained, place
from a4agent.experts.local.checkpoints import find_checkpoint
from a4agent.experts.local.generation import load_processor
from a4agent.imaging.masks import box_iou
from a4agent.protocols import DetectRequest, Role
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
    """A detector that scores boxes. A subclass prepares the inputs and reads the output.

    Args beyond those of `LocalExpert`:
        dtype: float32 unless set; the models are small, and their attention is sensitive.
        threshold: the least score of a box; OWLv2 0.2, Grounding DINO 0.3 unless set.
        nms_iou: of two boxes that overlap by more, the better one is kept; 1 keeps both. OWLv2 0.5 (neighbouring
            patches see the same object), Grounding DINO 1 unless set.
        max_boxes: the most boxes of an image.
    """

    provider: ClassVar[str]
    """Also the checkpoints' `model_type`."""
    model_class: ClassVar[str]
    usual: ClassVar[tuple[float, float]] = (0.3, 1.0)
    """The threshold and the `nms_iou` unless they are set."""

    def __init__(
        self,
        model: str,
        role: Role,
        *,
        revision: str | None = None,
        device: str = "auto",
        dtype: str = "float32",
        threshold: float | None = None,
        nms_iou: float | None = None,
        max_boxes: int = 20,
        max_batch: int = 4,
    ) -> None:
        self._selection = BoxSelection(
            self.usual[0] if threshold is None else threshold, self.usual[1] if nms_iou is None else nms_iou, max_boxes
        )
        placement = place(device, dtype)
        checkpoint = find_checkpoint(model, kinds=(self.provider,), revision=revision)
        settings = vars(self._selection)
        super().__init__(f"{self.provider}:{model}", checkpoint, placement, settings=settings, max_batch=max_batch)
        self._processor: Any = None

    def detect(self, requests: Sequence[DetectRequest]) -> list[Detection | A4Error]:
        """Boxes with scores, best first; the points are derived from the boxes, one for each."""
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


class GroundingDino(OpenVocabularyDetector):
    """A box's score is its best over the words of the phrase, and its point is its centre."""

    provider = "grounding-dino"
    model_class = "GroundingDinoForObjectDetection"

    def inputs_of(self, requests: Sequence[DetectRequest]) -> Any:
        return self._processor(
            images=[request.image for request in requests],
            text=[as_caption(request.phrase) for request in requests],
            padding=True,
            truncation=True,
            max_length=self._model.config.max_text_len,
            return_tensors="pt",
        )

    def candidates_of(self, output: Any, k: int, size_wh: tuple[int, int]) -> Candidates:
        boxes, scores = _boxes_and_scores(output, k, size_wh)
        return Candidates(boxes, scores, centres(boxes))


class MMGroundingDino(GroundingDino):
    """Grounding DINO as OpenMMLab trained it, with the same settings."""

    provider = "mm-grounding-dino"
    model_class = "MMGroundingDinoForObjectDetection"


class Owlv2(OpenVocabularyDetector):
    """Sees the image padded to a square at its right or bottom, and predicts one box from every patch of it.

    The point of a box is the patch that predicted it, where that lies inside the box, else its centre.
    """

    provider = "owlv2"
    model_class = "Owlv2ForObjectDetection"
    usual = (0.2, 0.5)

    def inputs_of(self, requests: Sequence[DetectRequest]) -> Any:
        return self._processor(
            images=[request.image for request in requests],
            text=[[request.phrase] for request in requests],
            truncation=True,
            return_tensors="pt",
        )

    def candidates_of(self, output: Any, k: int, size_wh: tuple[int, int]) -> Candidates:
        square = (max(size_wh), max(size_wh))
        boxes, scores = _boxes_and_scores(output, k, square)
        patches = to_pixels(_patch_centres(len(boxes)), UNIT, square)
        inside = ((patches >= boxes[:, :2]) & (patches < boxes[:, 2:])).all(1, keepdims=True)
        return Candidates(boxes, scores, np.where(inside, patches, centres(boxes)))


def as_caption(phrase: str) -> str:
    """Lower case with one full stop at the end, which separates phrases."""
    return " ".join(phrase.replace(".", " ").lower().split()) + "."


def _boxes_and_scores(output: Any, k: int, size_wh: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    scores = output.logits[k].float().sigmoid().amax(-1).cpu().numpy()
    return to_pixels(to_corners(output.pred_boxes[k].float().cpu().numpy()), UNIT, size_wh), scores


def _patch_centres(count: int) -> np.ndarray:
    """(count, 2) middles of the patches of a square, row by row, in units of its side."""
    side = round(count**0.5)
    y, x = np.divmod(np.arange(count), side)
    return (np.stack([x, y], axis=1) + 0.5) / side


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
        if nms_iou >= 1 or not kept or box_iou(boxes_xyxy[k], boxes_xyxy[kept]).max() <= nms_iou:
            kept.append(int(k))
    return np.array(kept, int)
