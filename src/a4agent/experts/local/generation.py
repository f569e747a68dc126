"""Images and text in, token ids out: one batch through a vision-language model of transformers.

model = ChatModel.load(checkpoint, placement)
model.generate([Turn(images=(photo,), text="What is this?")], max_new_tokens=[64])
    -> [Generation(ids=[785, 1614, ...], tokens_in=352, finish_reason="stop")]
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from PIL.Image import Image

from a4agent.errors import ModelFilesError, require
from a4agent.experts.local.base import QUANTISE, Placement, load_pretrained
from a4agent.experts.local.checkpoints import Checkpoint


@dataclass(frozen=True, eq=False)
class Turn:
    """One question: the images come before the text."""

    images: tuple[Image, ...]
    text: str
    system: str | None = None


@dataclass(frozen=True)
class Generation:
    """The new ids without padding; `finish_reason` is "stop", or "length" if the limit cut the answer off."""

    ids: list[int]
    tokens_in: int
    finish_reason: str


@dataclass(frozen=True)
class ChatModel:
    """A model with its processor; `template` are further arguments of its chat template (`enable_thinking`)."""

    model: Any
    processor: Any
    template: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def load(
        cls,
        checkpoint: Checkpoint,
        placement: Placement,
        processor: Any | None = None,
        template: Mapping[str, Any] | None = None,
    ) -> ChatModel:
        """Load what `AutoModelForImageTextToText` knows.

        Raises:
            ModelFilesError, ResourceError: see `load_pretrained`.
        """
        transformers: Any = require("transformers", extra="local")
        processor = processor or load_processor(checkpoint.folder)
        auto = transformers.AutoModelForImageTextToText
        return cls(load_pretrained(auto, checkpoint, placement, shrinking=(QUANTISE,)), processor, template or {})

    def generate(
        self, turns: Sequence[Turn], max_new_tokens: Sequence[int], sampling: Mapping[str, Any] | None = None
    ) -> list[Generation]:
        """Answer all turns in one batch, padded on the left; greedy unless `sampling` (of `generate`) says otherwise.

        Turns with and without images cannot share a batch: all or none have some.
        """
        inputs = self._inputs(turns)
        longest = inputs["input_ids"].shape[1]
        # Left out, temperature and the like would come from the checkpoint and be warned of.
        greedy: dict[str, Any] = {"do_sample": False, "temperature": None, "top_p": None, "top_k": None}
        output = self.model.generate(
            **inputs,
            **{**greedy, **(sampling or {})},
            max_new_tokens=max(max_new_tokens),
            pad_token_id=self._pad_token_id,
        )
        tokens_in = inputs["attention_mask"].sum(1).tolist()
        return [
            self._until_end(ids[longest:].tolist(), int(count), limit)
            for ids, count, limit in zip(output, tokens_in, max_new_tokens, strict=True)
        ]

    def decode(self, ids: Sequence[int], *, skip_special_tokens: bool = True) -> str:
        """The text of ids."""
        return self.processor.tokenizer.decode(
            ids, skip_special_tokens=skip_special_tokens, clean_up_tokenization_spaces=False
        )

    def _inputs(self, turns: Sequence[Turn]) -> dict[str, Any]:
        texts = [
            self.processor.apply_chat_template(
                _messages(turn), tokenize=False, add_generation_prompt=True, **self.template
            )
            for turn in turns
        ]
        inputs = self.processor(
            text=texts,
            images=[list(turn.images) for turn in turns] if turns[0].images else None,
            padding=True,
            padding_side="left",
            return_tensors="pt",
            return_mm_token_type_ids=True,
        )
        inputs = inputs.to(self.model.device, dtype=self.model.dtype)
        # Qwen-VL needs mm_token_type_ids (without it all positions are one-dimensional), others do not know it.
        known = inspect.signature(self.model.forward).parameters
        return {name: value for name, value in inputs.items() if name != "mm_token_type_ids" or name in known}

    def _until_end(self, ids: list[int], tokens_in: int, limit: int) -> Generation:
        end = next((k for k, token in enumerate(ids) if token in self._end_token_ids), None)
        if end is not None and end < limit:
            return Generation(ids[:end], tokens_in, "stop")
        return Generation(ids[:limit], tokens_in, "length")

    @property
    def _end_token_ids(self) -> set[int]:
        end = self.model.generation_config.eos_token_id
        return set(end if isinstance(end, list) else [end]) - {None}

    @property
    def _pad_token_id(self) -> int:
        pad = self.processor.tokenizer.pad_token_id
        return min(self._end_token_ids) if pad is None else pad


def load_processor(folder: Path, class_name: str | None = None) -> Any:
    """The processor of a checkpoint; without torchvision one that takes images and no video.

    `class_name` is the processor's class if the folder does not name it (a part of a pipeline).

    Raises:
        ModelFilesError: its files are missing or damaged.
    """
    transformers: Any = require("transformers", extra="local")
    try:
        try:
            loader = getattr(transformers, class_name or "AutoProcessor")
            processor = loader.from_pretrained(str(folder), local_files_only=True)
        except (ImportError, ValueError) as error:  # which of them depends on the model's video half
            if "torchvision" not in str(error).lower():
                raise
            processor = _without_video(transformers, folder, class_name)
    except (OSError, ValueError, KeyError, ImportError) as error:
        raise ModelFilesError(f"the processor in {str(folder)!r} cannot be loaded: {error}") from error
    if not hasattr(processor, "image_processor"):
        raise ModelFilesError(f"{str(folder)!r} takes no images: it has a {type(processor).__name__} only")
    return processor


def _without_video(transformers: Any, folder: Path, class_name: str | None) -> Any:
    """The checkpoint's own processor class, put together without its video half (which needs torchvision)."""
    if class_name:
        base = getattr(transformers, class_name)
    else:
        mapping: Any = require("transformers.models.auto.processing_auto", extra="local")
        base = mapping.PROCESSOR_MAPPING[type(transformers.AutoConfig.from_pretrained(str(folder)))]
    saved, _ = base.get_processor_dict(str(folder), local_files_only=True)
    tokenizer = transformers.AutoTokenizer.from_pretrained(str(folder), local_files_only=True)

    class ImageProcessorOnly(base):
        def check_argument_for_proper_class(self, argument_name: str, argument: Any) -> Any:
            if argument_name == "video_processor":
                return type(None)
            return super().check_argument_for_proper_class(argument_name, argument)

    parameters = inspect.signature(base.__init__).parameters
    given: dict[str, Any] = {name: value for name, value in saved.items() if name in parameters}
    given |= {
        "image_processor": transformers.AutoImageProcessor.from_pretrained(
            str(folder), local_files_only=True, backend="pil"
        ),
        "tokenizer": tokenizer,
        "video_processor": None,
    }
    given["chat_template"] = given.get("chat_template") or tokenizer.chat_template
    return ImageProcessorOnly(**given)


def _messages(turn: Turn) -> list[dict[str, Any]]:
    content: list[dict[str, Any]] = [{"type": "image"} for _ in turn.images]
    content.append({"type": "text", "text": turn.text})
    user: dict[str, Any] = {"role": "user", "content": content}
    if turn.system is None:
        return [user]
    return [{"role": "system", "content": [{"type": "text", "text": turn.system}]}, user]
