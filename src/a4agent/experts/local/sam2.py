"""`sam2:tiny|small|base-plus|large` (SAM 2.1), or any SAM 2 checkpoint by name or folder: boxes and points to masks.

    sam = SamSegmenter("large", "segmenter")
    sam.segment([SegmentRequest(image=photo, prompts=(Prompt(box_xyxy=..., points_xy=...),))])

An image goes through the encoder once and its embedding is kept; all prompts of an image that are of one kind
(with or without a box, the same number of points) go through the mask decoder together. They are not padded to
one kind, because padding takes part in the decoder's attention and so changes the masks.

Source: Ravi et al., SAM 2 (arXiv 2408.00714); preprocessing of the checkpoints' own processor.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from PIL.Image import Image

from a4agent.errors import A4Error, ConfigError, UnknownNameError, require
from a4agent.experts.hub import full_name
from a4agent.experts.local.base import LocalExpert, Placement, Stopwatch, load_pretrained, place
from a4agent.experts.local.checkpoints import find_checkpoint
from a4agent.imaging.load import image_hash
from a4agent.protocols import Prompt, Role, Segmentation, SegmentRequest

IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))

_PROMPTS_AT_ONCE = 32  # the decoder holds some 25 MB for each


class SamSegmenter(LocalExpert):
    """A SAM 2 segmenter: an image encoder, and a decoder for boxes and points.

    Args beyond those of `LocalExpert`:
        model: also "tiny", "small", "base-plus" or "large".
        dtype: of the image encoder. Prompts and masks are always computed in float32.
        candidates: "best" keeps the mask with the highest predicted IoU of each prompt's three, "all" keeps them.
        cached_images: how many images' embeddings are kept (17 MB each).

    Raises:
        UnknownNameError: no such size, and not a name or folder either.
    """

    provider: ClassVar[str] = "sam2"
    kinds: ClassVar[tuple[str, ...]] = ("sam2", "sam2_video")
    model_class: ClassVar[str] = "Sam2Model"
    mean_and_std: ClassVar[tuple[tuple[float, ...], tuple[float, ...]]] = IMAGENET

    def __init__(
        self,
        model: str,
        role: Role,
        *,
        revision: str | None = None,
        device: str = "auto",
        dtype: str = "auto",
        candidates: str = "best",
        max_batch: int = 4,
        cached_images: int = 8,
    ) -> None:
        id = f"{self.provider}:{model}"
        if candidates not in ("best", "all"):
            raise UnknownNameError.of("value of candidates", candidates, ("best", "all"))
        if cached_images < 0:
            raise ConfigError(f"cached_images of {id!r} must be at least 0, not {cached_images!r}")
        placement = place(device, dtype)
        checkpoint = find_checkpoint(full_name(self.provider, model), kinds=self.kinds, revision=revision)
        super().__init__(id, checkpoint, placement, settings={"candidates": candidates}, max_batch=max_batch)
        self._candidates = candidates
        self._cached_images = cached_images
        self._embeddings: OrderedDict[str, list[Any]] = OrderedDict()

    def prepare(self, images: Sequence[Image]) -> None:
        """Encode images ahead of their prompts. What does not fit the cache, or memory, is left for `segment`.

        Once closed it does nothing until `segment` is asked again: weights are not loaded for a run that is over.
        """
        with self._lock:
            if not self._closed:
                self._in_batches(images[: self._cached_images], self._encode)

    def segment(self, requests: Sequence[SegmentRequest]) -> list[Segmentation | A4Error]:
        """Masks at the size of each image, in the order of its prompts."""
        return self._in_batches(requests, self._segment)

    def _load(self) -> None:
        transformers: Any = require("transformers", extra="local")
        whole = Placement(self.placement.device, "float32")
        self._model = load_pretrained(getattr(transformers, self.model_class), self.checkpoint, whole)

    def _unload(self) -> None:
        super()._unload()
        self._embeddings.clear()

    def _segment(self, requests: Sequence[SegmentRequest]) -> list[Segmentation]:
        watch = Stopwatch()
        embeddings = self._encode([request.image for request in requests])
        return [
            Segmentation(*self._decode(embedding, request), usage=watch.usage(len(requests)))
            for embedding, request in zip(embeddings, requests, strict=True)
        ]

    def _encode(self, images: Sequence[Image]) -> list[list[Any]]:
        """The embeddings of images, from the cache where they are in it; each a list of tensors (1, C, h, w)."""
        torch: Any = require("torch", extra="local")
        names = [image_hash(image) for image in images]
        missing = {name: image for name, image in zip(names, images, strict=True) if name not in self._embeddings}
        found = {name: self._embeddings[name] for name in names if name in self._embeddings}
        if missing:
            side = self._side()
            pixels = torch.cat([to_square(image, side, *self.mean_and_std) for image in missing.values()])
            with autocast(self.placement):
                levels = self._model.get_image_embeddings(pixels.to(self.placement.input_device))
            for k, name in enumerate(missing):
                found[name] = [level[k : k + 1].float() for level in levels]
        for name in names:
            self._embeddings[name] = found[name]
            self._embeddings.move_to_end(name)
        while len(self._embeddings) > self._cached_images:
            self._embeddings.popitem(last=False)
        return [found[name] for name in names]

    def _decode(self, embedding: list[Any], request: SegmentRequest) -> tuple[np.ndarray, np.ndarray]:
        """Masks (p, c, H, W) bool and predicted IoU (p, c) float32."""
        width, height = request.image.size
        count = 1 if self._candidates == "best" else 3
        masks = np.zeros((len(request.prompts), count, height, width), bool)
        predicted_iou = np.zeros((len(request.prompts), count), np.float32)
        for indices in _same_kind(request.prompts):
            for start in range(0, len(indices), _PROMPTS_AT_ONCE):
                chunk = indices[start : start + _PROMPTS_AT_ONCE]
                low, iou = self._ask_decoder(embedding, [request.prompts[k] for k in chunk], request.image.size)
                for k, candidates, quality in zip(chunk, low, iou, strict=True):
                    masks[k] = resized_mask(candidates, height, width)
                    predicted_iou[k] = quality.cpu().numpy()
        return masks, predicted_iou

    def _ask_decoder(
        self, embedding: list[Any], prompts: Sequence[Prompt], size_wh: tuple[int, int]
    ) -> tuple[Any, Any]:
        """Mask logits (p, c, h, w) and predicted IoU (p, c) of prompts of one kind."""
        torch: Any = require("torch", extra="local")
        scale = np.float32(self._side()) / np.asarray(size_wh, np.float32)

        def tensor(values: list[np.ndarray]) -> Any:
            return torch.from_numpy(np.stack(values)[None]).to(self.placement.input_device)

        inputs: dict[str, Any] = {}
        if len(prompts[0].points_xy):
            inputs["input_points"] = tensor([np.asarray(p.points_xy, np.float32) * scale for p in prompts])
            inputs["input_labels"] = torch.ones_like(inputs["input_points"][..., 0], dtype=torch.int64)
        if prompts[0].box_xyxy is not None:
            inputs["input_boxes"] = tensor([np.asarray(p.box_xyxy, np.float32) * np.tile(scale, 2) for p in prompts])
        output = self._model(image_embeddings=embedding, multimask_output=True, **inputs)
        masks, iou = output.pred_masks[0], output.iou_scores[0]
        if self._candidates == "best":
            best = iou.argmax(-1, keepdim=True)
            masks, iou = masks.take_along_dim(best[..., None, None], 1), iou.take_along_dim(best, 1)
        return masks, iou

    def _side(self) -> int:
        return int(self._model.prompt_encoder.input_image_size)


def to_square(image: Image, side: int, mean: Sequence[float], std: Sequence[float]) -> Any:
    """An RGB image as the (1, 3, side, side) float32 tensor that SAM's encoders take (squeezed, not padded)."""
    torch: Any = require("torch", extra="local")
    pixels = torch.from_numpy(np.array(image.convert("RGB"))).permute(2, 0, 1)[None]
    # In whole numbers, as the checkpoints' processors resize: in floats a fifth of the pixels would differ by one.
    pixels = torch.nn.functional.interpolate(pixels, size=(side, side), mode="bilinear", antialias=True).float() / 255
    return (pixels - torch.tensor(mean).view(3, 1, 1)) / torch.tensor(std).view(3, 1, 1)


def _same_kind(prompts: Sequence[Prompt]) -> list[list[int]]:
    """The indices of prompts that can share a decode."""
    kinds: dict[tuple[bool, int], list[int]] = {}
    for k, prompt in enumerate(prompts):
        kinds.setdefault((prompt.box_xyxy is not None, len(prompt.points_xy)), []).append(k)
    return list(kinds.values())


def resized_mask(values: Any, height: int, width: int, above: float = 0.0) -> np.ndarray:
    """Masks (c, height, width) of where values (c, h, w), resized, are above a limit."""
    torch: Any = require("torch", extra="local")
    resized = torch.nn.functional.interpolate(
        values[None].float(), size=(height, width), mode="bilinear", align_corners=False
    )
    return (resized[0] > above).cpu().numpy()


def autocast(placement: Placement) -> Any:
    """The encoder in half precision, its weights and residuals in float32: as the checkpoints' authors run it."""
    torch: Any = require("torch", extra="local")
    kind = torch.device(placement.input_device).type
    return torch.autocast(kind, dtype=placement.torch_dtype, enabled=placement.dtype != "float32")


create = SamSegmenter
