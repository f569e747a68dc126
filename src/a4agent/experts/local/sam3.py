"""`sam3:NAME_OR_FOLDER`: SAM 3, a phrase to masks (a detector that segments: a Spotter in one model), or a segmenter.

    create("facebook/sam3", "detector").detect([DetectRequest(image=photo, phrase="handle")])
        -> [Detection(boxes_xyxy=(n, 4), scores=(n,), masks=(n, H, W))]
    create("facebook/sam3", "segmenter")       # boxes and points to masks, as `sam2:`

The weights are under the SAM licence. Source: SAM 3 (arXiv 2511.16719); preprocessing of the checkpoint's processor.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from a4agent.errors import A4Error, ConfigError, ModelFilesError, require
from a4agent.experts.coordinates import UNIT, to_pixels
from a4agent.experts.local.base import LocalExpert, Placement, Stopwatch, load_pretrained, place
from a4agent.experts.local.checkpoints import find_checkpoint
from a4agent.experts.local.sam2 import SamSegmenter, autocast, resized_mask, to_square
from a4agent.protocols import DetectRequest, Role
from a4agent.types import Detection

HALF = ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))
WORDS = 32  # tokens of a phrase, padding included


def create(
    model: str,
    role: Role,
    *,
    revision: str | None = None,
    device: str = "auto",
    dtype: str = "auto",
    threshold: float = 0.3,
    candidates: str = "best",
    max_batch: int = 4,
    cached_images: int = 8,
) -> Sam3Detector | Sam3Segmenter:
    """SAM 3 as "detector" or "segmenter".

    `threshold` is the least score of an instance and concerns the detector alone; `candidates` and `cached_images` are
    the segmenter's. The other settings are those of `sam2:`.

    Raises:
        ModelFilesError: no such checkpoint, or the hub cannot be reached.
        ConfigError: a setting has a value it does not take.
    """
    shared: dict[str, Any] = {"revision": revision, "device": device, "dtype": dtype, "max_batch": max_batch}
    if role == "segmenter":
        return Sam3Segmenter(model, role, candidates=candidates, cached_images=cached_images, **shared)
    return Sam3Detector(model, role, threshold=threshold, **shared)


class Sam3Segmenter(SamSegmenter):
    """SAM 3's tracker: an image encoder, and SAM 2's decoder for boxes and points."""

    provider = "sam3"
    kinds = ("sam3_video", "sam3_tracker", "sam3_tracker_video")
    model_class = "Sam3TrackerModel"
    mean_and_std = HALF


class Sam3Detector(LocalExpert):
    """Finds all instances of a phrase, each with a mask."""

    def __init__(
        self,
        model: str,
        role: Role,
        *,
        revision: str | None = None,
        device: str = "auto",
        dtype: str = "auto",
        threshold: float = 0.3,
        max_batch: int = 4,
    ) -> None:
        if not 0 <= threshold < 1:
            raise ConfigError(f"threshold must be in [0, 1), not {threshold!r}")
        placement = place(device, dtype)
        checkpoint = find_checkpoint(model, kinds=("sam3", "sam3_video"), revision=revision)
        super().__init__(f"sam3:{model}", checkpoint, placement, settings={"threshold": threshold}, max_batch=max_batch)
        self._threshold = threshold
        self._tokenizer: Any = None

    def detect(self, requests: Sequence[DetectRequest]) -> list[Detection | A4Error]:
        """Instances with boxes, scores and masks, best first, and no points."""
        return self._in_batches(requests, self._answer)

    def _load(self) -> None:
        transformers: Any = require("transformers", extra="local")
        folder = str(self.checkpoint.folder)
        try:
            self._tokenizer = transformers.AutoTokenizer.from_pretrained(folder, local_files_only=True)
        except (OSError, ValueError, KeyError) as error:
            raise ModelFilesError(f"the tokenizer in {folder!r} cannot be loaded: {error}") from error
        whole = Placement(self.placement.device, "float32")
        self._model = load_pretrained(transformers.Sam3Model, self.checkpoint, whole)

    def _answer(self, requests: Sequence[DetectRequest]) -> list[Detection]:
        torch: Any = require("torch", extra="local")
        watch = Stopwatch()
        side = int(self._model.vision_encoder.config.image_size)
        pixels = torch.cat([to_square(request.image, side, *HALF) for request in requests])
        words = self._tokenizer(
            [request.phrase for request in requests],
            padding="max_length",
            max_length=WORDS,
            truncation=True,
            return_tensors="pt",
        )
        device = self.placement.input_device
        with autocast(self.placement):
            output = self._model(
                pixel_values=pixels.to(device),
                input_ids=words["input_ids"].to(device),
                attention_mask=words["attention_mask"].to(device),
            )
        return [self._read(output, k, request, watch, len(requests)) for k, request in enumerate(requests)]

    def _read(self, output: Any, k: int, request: DetectRequest, watch: Stopwatch, shared_by: int) -> Detection:
        width, height = request.image.size
        scores = output.pred_logits[k].float().sigmoid()
        if output.presence_logits is not None:
            scores = scores * output.presence_logits[k].float().sigmoid()
        keep = (scores > self._threshold).nonzero().flatten()
        keep = keep[scores[keep].argsort(descending=True)]
        masks = np.zeros((len(keep), height, width), bool)
        for row, instance in enumerate(keep.tolist()):
            # The checkpoint's processor resizes probabilities, not logits.
            probability = output.pred_masks[k, instance : instance + 1].float().sigmoid()
            masks[row] = resized_mask(probability, height, width, above=0.5)[0]
        boxes = to_pixels(output.pred_boxes[k, keep].float().cpu().numpy(), UNIT, request.image.size)
        return Detection(
            boxes_xyxy=boxes.reshape(-1, 4).astype(np.float32),
            scores=scores[keep].cpu().numpy().astype(np.float32),
            masks=masks,
            usage=watch.usage(shared_by),
        )
