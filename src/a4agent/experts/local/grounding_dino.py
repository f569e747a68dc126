"""`grounding-dino:NAME_OR_FOLDER` and `mm-grounding-dino:NAME_OR_FOLDER`: scored boxes for a phrase.

    create("IDEA-Research/grounding-dino-tiny", "detector").detect([DetectRequest(image=photo, phrase="the handle")])
    create_mm("openmmlab-community/mm_grounding_dino_tiny_o365v1_goldg_v3det", "detector")

The point of each box is its centre. Source: Liu et al., Grounding DINO (arXiv 2303.05499).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from a4agent.experts.coordinates import UNIT, to_pixels
from a4agent.experts.local.base import place
from a4agent.experts.local.checkpoints import find_checkpoint
from a4agent.experts.local.open_vocabulary import BoxSelection, Candidates, OpenVocabularyDetector, centres, to_corners
from a4agent.protocols import DetectRequest, Role

THRESHOLD = 0.3


def create(
    model: str,
    role: Role,
    *,
    revision: str | None = None,
    device: str = "auto",
    dtype: str = "float32",
    threshold: float = THRESHOLD,
    nms_iou: float = 1.0,
    max_boxes: int = 20,
    max_batch: int = 4,
) -> GroundingDino:
    """A Grounding DINO detector.

    Args:
        model: a folder, or a name on the hub.
        role: "detector".
        revision: branch, tag or commit.
        device: "auto" or a torch device.
        dtype: number format; the model is small and its attention sensitive, so float32.
        threshold: the least score of a box.
        nms_iou: of two boxes that overlap by more, the better one is kept; 1 keeps both.
        max_boxes: the most boxes of an image.
        max_batch: the most images at once; halved whenever memory runs out.

    Raises:
        ModelFilesError: no such checkpoint, or the hub cannot be reached.
        ConfigError: a setting has a value it does not take.
    """
    selection = BoxSelection(threshold, nms_iou, max_boxes)
    placement = place(device, dtype)
    checkpoint = find_checkpoint(model, kinds=("grounding-dino",), revision=revision)
    return GroundingDino(f"grounding-dino:{model}", checkpoint, placement, selection, max_batch)


def create_mm(
    model: str,
    role: Role,
    *,
    revision: str | None = None,
    device: str = "auto",
    dtype: str = "float32",
    threshold: float = THRESHOLD,
    nms_iou: float = 1.0,
    max_boxes: int = 20,
    max_batch: int = 4,
) -> GroundingDino:
    """An MM-Grounding-DINO detector; settings and errors as for `create`."""
    selection = BoxSelection(threshold, nms_iou, max_boxes)
    placement = place(device, dtype)
    checkpoint = find_checkpoint(model, kinds=("mm-grounding-dino",), revision=revision)
    return MMGroundingDino(f"mm-grounding-dino:{model}", checkpoint, placement, selection, max_batch)


class GroundingDino(OpenVocabularyDetector):
    """A box's score is its best over the words of the phrase."""

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
        scores = output.logits[k].float().sigmoid().amax(-1).cpu().numpy()
        boxes = to_pixels(to_corners(output.pred_boxes[k].float().cpu().numpy()), UNIT, size_wh)
        return Candidates(np.asarray(boxes), scores, centres(boxes))


class MMGroundingDino(GroundingDino):
    model_class = "MMGroundingDinoForObjectDetection"


def as_caption(phrase: str) -> str:
    """Lower case with one full stop at the end, which separates phrases."""
    return " ".join(phrase.replace(".", " ").lower().split()) + "."
