"""`owlv2:NAME_OR_FOLDER`: scored boxes for a phrase, and the place in each that looks most like it.

    create("google/owlv2-base-patch16", "detector").detect([DetectRequest(image=photo, phrase="the handle")])

OWLv2 predicts one box from every patch of the image. The point of a box is the patch that predicted it, where that
lies inside the box, else the centre. Source: Minderer et al., OWLv2 (arXiv 2306.09683).
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


def create(
    model: str,
    role: Role,
    *,
    revision: str | None = None,
    device: str = "auto",
    dtype: str = "float32",
    threshold: float = 0.2,
    nms_iou: float = 0.5,
    max_boxes: int = 20,
    max_batch: int = 4,
) -> Owlv2:
    """An OWLv2 detector.

    Args:
        model: a folder, or a name on the hub.
        role: "detector".
        revision: branch, tag or commit.
        device: "auto" or a torch device.
        dtype: "float32", "bfloat16", "float16" or "auto".
        threshold: the least score of a box.
        nms_iou: of two boxes that overlap by more, the better one is kept (neighbouring patches see the same
            object); 1 keeps both.
        max_boxes: the most boxes of an image.
        max_batch: the most images at once; halved whenever memory runs out.

    Raises:
        ModelFilesError: no such checkpoint, or the hub cannot be reached.
        ConfigError: a setting has a value it does not take.
    """
    selection = BoxSelection(threshold, nms_iou, max_boxes)
    placement = place(device, dtype)
    checkpoint = find_checkpoint(model, kinds=("owlv2",), revision=revision)
    return Owlv2(f"owlv2:{model}", checkpoint, placement, selection, max_batch)


class Owlv2(OpenVocabularyDetector):
    """Sees the image padded to a square at its right or bottom."""

    model_class = "Owlv2ForObjectDetection"

    def inputs_of(self, requests: Sequence[DetectRequest]) -> Any:
        return self._processor(
            images=[request.image for request in requests],
            text=[[request.phrase] for request in requests],
            truncation=True,
            return_tensors="pt",
        )

    def candidates_of(self, output: Any, k: int, size_wh: tuple[int, int]) -> Candidates:
        square = (max(size_wh), max(size_wh))
        scores = output.logits[k].float().sigmoid().amax(-1).cpu().numpy()
        boxes = to_pixels(to_corners(output.pred_boxes[k].float().cpu().numpy()), UNIT, square)
        patches = to_pixels(_patch_centres(len(boxes)), UNIT, square)
        inside = ((patches >= boxes[:, :2]) & (patches < boxes[:, 2:])).all(1, keepdims=True)
        return Candidates(boxes, scores, np.where(inside, patches, centres(boxes)))


def _patch_centres(count: int) -> np.ndarray:
    """(count, 2) middles of the patches of a square, row by row, in units of its side."""
    side = round(count**0.5)
    y, x = np.divmod(np.arange(count), side)
    return (np.stack([x, y], axis=1) + 0.5) / side
