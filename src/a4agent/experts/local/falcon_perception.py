"""`falcon-perception:NAME_OR_FOLDER`: Falcon Perception, a phrase to masks in one model of 0.6 billion parameters.

    FalconPerception("tiiuae/Falcon-Perception", "detector", trust_remote_code=True)
        .detect([DetectRequest(image=photo, phrase="handle")])      -> [Detection(boxes_xyxy=(n, 4), masks=(n, H, W))]

transformers does not hold this architecture: its code lies in the model's repository, is fetched with the weights and
runs with your rights. Hence `trust_remote_code`, which nobody sets for you.

Source: the model's card (Apache-2.0) and Falcon Perception (arXiv 2603.27365).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from a4agent.errors import A4Error, ConfigError, DataError, ProviderError, require
from a4agent.experts.coordinates import UNIT, to_pixels
from a4agent.experts.local.base import LocalExpert, Stopwatch, load_pretrained, place
from a4agent.experts.local.checkpoints import find_checkpoint
from a4agent.experts.local.open_vocabulary import to_corners
from a4agent.imaging.masks import decode_rle
from a4agent.protocols import DetectRequest, Role
from a4agent.types import Detection


class FalconPerception(LocalExpert):
    """Finds all instances of a phrase, each with a box and, if the model segments, a mask.

    Args beyond those of `LocalExpert`:
        trust_remote_code: run the Python code in the model's repository; a `revision` that is a commit pins that code.
        dtype: float32, as published.
        max_dimension: the longer side, in pixels, that larger images are scaled down to.
        compile: compile the network at the first request, which pays off over many.

    Raises:
        ConfigError: `trust_remote_code` is not set.
    """

    def __init__(
        self,
        model: str,
        role: Role,
        *,
        trust_remote_code: bool = False,
        revision: str | None = None,
        device: str = "auto",
        dtype: str = "float32",
        max_dimension: int = 1024,
        compile: bool = False,
        max_batch: int = 4,
    ) -> None:
        id = f"falcon-perception:{model}"
        if not trust_remote_code:
            raise ConfigError(
                f"{id!r} runs the Python code in the model's repository, with your rights: read its *.py files, pin"
                " them with the setting revision = COMMIT, then set trust_remote_code = true"
            )
        if max_dimension < 1:
            raise ConfigError(f"max_dimension must be a positive number of pixels, not {max_dimension!r}")
        placement = place(device, dtype)
        checkpoint = find_checkpoint(model, kinds=("falcon_perception",), revision=revision)
        options = {"max_dimension": max_dimension, "compile": compile}
        super().__init__(id, checkpoint, placement, settings=options, max_batch=max_batch)
        self._options = options

    def detect(self, requests: Sequence[DetectRequest]) -> list[Detection | A4Error]:
        """Instances with boxes and masks, in the model's order, without scores and points.

        Raises:
            ConfigError: the model's code needs a package that is not installed.
        """
        return self._in_batches(requests, self._answer)

    def _load(self) -> None:
        transformers: Any = require("transformers", extra="local")
        self._model = load_pretrained(
            transformers.AutoModelForCausalLM, self.checkpoint, self.placement, trust_remote_code=True
        )
        # transformers 5 leaves buffers that are not saved, here the positions' rotations, with arbitrary numbers.
        if hasattr(self._model, "_ensure_device_buffers"):
            self._model._weights_fused = False
            self._model._ensure_device_buffers()

    def _answer(self, requests: Sequence[DetectRequest]) -> list[Detection | A4Error]:
        watch = Stopwatch()
        images = [request.image for request in requests]
        found = self._model.generate(images, [request.phrase for request in requests], **self._options)
        usage = watch.usage(len(requests))
        answers: list[Detection | A4Error] = []
        for request, instances in zip(requests, found, strict=True):
            try:
                boxes_xyxy, masks = read_instances(instances, request.image.size)
                answers.append(Detection(boxes_xyxy=boxes_xyxy, masks=masks, usage=usage))
            except (KeyError, TypeError, ValueError, DataError) as error:
                answers.append(ProviderError(f"{self.id} gave an instance that cannot be read: {error!r}"))
        return answers


def read_instances(
    instances: Sequence[Mapping[str, Any]], size_wh: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray | None]:
    """The boxes (n, 4) float32 and masks (n, H, W) bool of the model's instances; masks are None if none has one.

        [{"xy": {"x": 0.5, "y": 0.25}, "hw": {"h": 0.5, "w": 0.2}, "mask_rle": {"size": [H, W], "counts": "a1b..."}}]

    Raises:
        KeyError, TypeError, ValueError, DataError: an instance is not of this form, or its mask of another size.
    """
    width, height = size_wh
    sides = [[one["xy"]["x"], one["xy"]["y"], one["hw"]["w"], one["hw"]["h"]] for one in instances]
    boxes = to_pixels(to_corners(np.array(sides, np.float64).reshape(-1, 4)), UNIT, size_wh).astype(np.float32)
    if instances and not any(one.get("mask_rle") for one in instances):
        return boxes, None
    masks = np.zeros((len(instances), height, width), bool)
    for mask, one in zip(masks, instances, strict=True):
        found = decode_rle(one["mask_rle"])
        if found.shape != mask.shape:
            raise ValueError(f"a mask of {found.shape} for an image of {mask.shape}")
        mask[:] = found
    return boxes, masks


create = FalconPerception
