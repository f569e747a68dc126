"""`sam2-video`: SAM 2's memory follows a mask through a video, frame by frame.

    tracker = Sam2VideoTracker(model="tiny")
    tracker.start(first_frame, mask)
    tracker.step(next_frame)                # Tracked(mask, quality)

The session keeps the features and memories of the frames that the model can still look back at, and drops the rest,
so that memory stays level however long the video is.

Source: Ravi et al., SAM 2 (arXiv 2408.00714); transformers' `Sam2VideoModel`, in streaming.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from PIL.Image import Image

from a4agent.errors import require
from a4agent.experts.hub import full_name
from a4agent.experts.local.base import Placement, load_pretrained, place
from a4agent.experts.local.checkpoints import find_checkpoint
from a4agent.experts.local.sam2 import IMAGENET, resized_mask, to_square
from a4agent.protocols import Tracked

LOOKS_BACK = 16
"""Frames whose memory the model may use: six masks and sixteen object pointers (the checkpoints' configuration)."""


class Sam2VideoTracker:
    """A tracker on a SAM 2.1 checkpoint.

    Args:
        model: "tiny", "small", "base-plus", "large", a folder, or OWNER/NAME.
        device: "auto" or a torch device.
    """

    def __init__(self, *, model: str = "tiny", revision: str | None = None, device: str = "auto") -> None:
        placement = place(device, "float32")
        self._device = placement.input_device
        checkpoint = find_checkpoint(full_name("sam2", model), kinds=("sam2", "sam2_video"), revision=revision)
        transformers: Any = require("transformers", extra="local")
        self._model: Any = load_pretrained(
            transformers.Sam2VideoModel, checkpoint, Placement(placement.device, "float32")
        )
        self._session: Any = None
        self._frame = 0

    def start(self, frame: Image, mask: np.ndarray) -> None:
        """Follow `mask` (H, W) bool of `frame` from here on."""
        torch: Any = require("torch", extra="local")
        video: Any = require("transformers.models.sam2_video.modeling_sam2_video", extra="local")
        self._session = video.Sam2VideoInferenceSession(
            video_height=frame.height, video_width=frame.width, inference_device=self._device, dtype=torch.float32
        )
        self._frame = 0
        side = self._side()
        given = torch.from_numpy(mask.astype(np.float32))[None, None]
        given = torch.nn.functional.interpolate(given, size=(side, side), mode="bilinear", antialias=True) >= 0.5
        index = self._session.obj_id_to_idx(1)
        self._session.add_mask_inputs(index, 0, given.float())
        self._session.obj_with_new_inputs = [1]
        self._ask(frame)

    def step(self, frame: Image) -> Tracked:
        """Where the mask is in the next frame; quality is the model's probability that the object is visible."""

        torch: Any = require("torch", extra="local")
        self._frame += 1
        output = self._ask(frame)
        mask = resized_mask(output.pred_masks[0], frame.height, frame.width)[0]
        return Tracked(mask, float(torch.sigmoid(output.object_score_logits.float()).max()))

    def close(self) -> None:
        """Release the model and the session."""
        self._model = self._session = None

    def _ask(self, frame: Image) -> Any:
        torch: Any = require("torch", extra="local")
        pixels = to_square(frame, self._side(), *IMAGENET).to(self._device)
        with torch.inference_mode():
            output = self._model(inference_session=self._session, frame=pixels[0], frame_idx=self._frame)
        session, oldest = self._session, self._frame - LOOKS_BACK
        for old in [index for index in session.processed_frames if index < self._frame]:
            del session.processed_frames[old]
        for kept in session.output_dict_per_obj.values():
            for old in [index for index in kept["non_cond_frame_outputs"] if index < oldest]:
                del kept["non_cond_frame_outputs"][old]
        return output

    def _side(self) -> int:
        return int(self._model.prompt_encoder.input_image_size)
