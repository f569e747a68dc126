"""`diffusers:NAME_OR_FOLDER`: an image editor in this process. `qwen-image-edit:` is the same provider.

    editor = DiffusersEditor("Qwen/Qwen-Image-Edit-2509", "editor")
    editor.edit([EditRequest(image=photo, prompt="Show a hand gripping ...")])
    DiffusersEditor("Qwen/Qwen-Image-Edit-2509", "editor", lightning=4)     # 4 forward passes instead of 60
    DiffusersEditor("black-forest-labs/FLUX.2-klein-4B", "editor")          # 4 steps, about 16 GB in bfloat16

The kind of pipeline is read from the folder's model_index.json; `PIPELINES` says what each takes. The defaults for
Qwen-Image-Edit are the settings of the A4-Agent authors: 30 steps, true CFG 4.0, negative prompt " ", seed 0 (which
comes with the request). Its weights are about 58 GB in bfloat16. Without offload they are read part by part straight
onto the accelerator; with offload they lie in main memory, where there has to be room for them.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from a4agent.errors import A4Error, ConfigError, ModelFilesError, ResourceError, UnknownNameError, require
from a4agent.experts.local.base import (
    QUANTISE,
    SPREAD,
    LocalExpert,
    Placement,
    Stopwatch,
    check_fits,
    is_out_of_memory,
    place,
)
from a4agent.experts.local.checkpoints import digest_of, find_checkpoint, find_file, parameter_count
from a4agent.experts.local.generation import load_processor
from a4agent.files import read_package_toml
from a4agent.imaging.load import load_image
from a4agent.protocols import EditAnswer, EditRequest, Role


@dataclass(frozen=True)
class PipelineKind:
    """What a kind of pipeline takes, and its defaults. `scale` names its guidance."""

    steps: int
    scale: str
    scale_value: float
    negative_prompt: str | None = None
    processor: str | None = None
    lightning: bool = False

    @property
    def settings(self) -> set[str]:
        """The settings that not every pipeline has."""
        optional = {"negative_prompt": self.negative_prompt is not None, "lightning": self.lightning}
        return {self.scale, *(name for name, known in optional.items() if known)}


PIPELINES = {
    "QwenImageEditPlusPipeline": PipelineKind(30, "true_cfg_scale", 4.0, " ", "Qwen2VLProcessor", True),
    "QwenImage21Pipeline": PipelineKind(40, "true_cfg_scale", 1.0, " ", "Qwen3VLProcessor"),
    "Flux2KleinPipeline": PipelineKind(4, "guidance_scale", 1.0),
}
"""Pipelines of diffusers that edit a picture, with the defaults of the authors (Qwen) or of the model's card."""
OFFLOADS = {"none": ("offload = 'model'",), "model": ("offload = 'sequential'",), "sequential": ()}
"""What may be offloaded, and the setting that needs still less memory."""
QUANTISED_PARTS = ["transformer", "text_encoder"]

LIGHTNING_SCHEDULER = {
    "base_image_seq_len": 256,
    "max_image_seq_len": 8192,
    "base_shift": math.log(3),
    "max_shift": math.log(3),
    "num_train_timesteps": 1000,
    "shift": 1.0,
    "shift_terminal": None,
    "use_dynamic_shifting": True,
    "time_shift_type": "exponential",
}
"""The schedule that the LoRAs were distilled with (model card of lightx2v/Qwen-Image-Lightning)."""


class DiffusersEditor(LocalExpert):
    """An image editor of diffusers. It edits one picture at a time: pipelines take no batches with prompts.

    Args beyond those of `LocalExpert`:
        quantisation: of the transformer and the text encoder.
        offload: "none"; "model" keeps one part at a time on the accelerator; "sequential" one layer (slow).
        lightning: 0, or 4 or 8 steps with the distilled LoRA of `model`.
        lora: the LoRA's file, on this disk or as OWNER/NAME/PATH on the hub, instead of Lightning's own.
        steps: denoising steps; the pipeline's default, or what `lightning` says.
        true_cfg_scale: Qwen: weight of the negative prompt; 1.0 (none, half the work) with `lightning`.
        guidance_scale: FLUX.2: weight of the prompt; the distilled models ignore it.
        negative_prompt: Qwen: what to lead away from.
        output_pixels: area of the edited picture, which keeps the proportions; less is faster.

    Raises:
        ModelFilesError: no such LoRA.
        ConfigError: the pipeline has no such setting.
    """

    def __init__(
        self,
        model: str,
        role: Role,
        *,
        revision: str | None = None,
        device: str = "auto",
        dtype: str = "auto",
        quantisation: str = "none",
        offload: str = "none",
        lightning: int = 0,
        lora: str | None = None,
        steps: int | None = None,
        true_cfg_scale: float | None = None,
        guidance_scale: float | None = None,
        negative_prompt: str | None = None,
        output_pixels: int = 1024 * 1024,
    ) -> None:
        placement = place(device, dtype, "auto", quantisation)
        _check_placement(placement, offload)
        if lightning not in (0, 4, 8):
            raise ConfigError(f"lightning is 0 (off), 4 or 8 steps, not {lightning!r}")
        if (steps is not None and steps < 1) or output_pixels < 32 * 32:
            raise ConfigError(
                f"steps ({steps!r}) must be at least 1, and output_pixels ({output_pixels!r}) at least 1024"
            )
        checkpoint = find_checkpoint(model, kinds=tuple(PIPELINES), revision=revision)
        kind = PIPELINES[checkpoint.kind]
        scales = {"true_cfg_scale": true_cfg_scale, "guidance_scale": guidance_scale}
        given = {**scales, "negative_prompt": negative_prompt, "lightning": lightning or None}
        for name, value in given.items():
            if value is not None and name not in kind.settings:
                raise ConfigError(
                    f"{model!r} is a {checkpoint.kind}, which takes no {name!r}; remove that setting of the editor"
                )
        if lightning and lora is None:
            loras = read_package_toml("a4agent.experts", "models.toml")["lightning"]
            if model not in loras:
                raise ConfigError(f"no Lightning LoRA is known for {model!r}: name its file with the setting lora")
            lora = str(loras[model]).format(steps=lightning)
        self._lora = find_file(lora) if lora else None
        scale = scales[kind.scale]
        settings = {
            "lightning": lightning,
            "lora": lora,
            "lora_digest": digest_of(self._lora) if self._lora else None,
            "steps": steps or lightning or kind.steps,
            kind.scale: (1.0 if lightning else kind.scale_value) if scale is None else scale,
            "negative_prompt": kind.negative_prompt if negative_prompt is None else negative_prompt,
            "output_pixels": output_pixels,
        }
        id = f"qwen-image-edit:{model}" if kind.lightning else f"diffusers:{model}"
        super().__init__(id, checkpoint, placement, settings=settings)
        self.shrinking = (*OFFLOADS[offload], QUANTISE)
        self._kind = kind
        self._offload = offload

    def edit(self, requests: Sequence[EditRequest]) -> list[EditAnswer | A4Error]:
        """The edited pictures, in the proportions of the originals and an area of `output_pixels`."""
        return self._in_batches(requests, self._edit)

    def _load(self) -> None:
        diffusers: Any = require("diffusers", extra="local")
        folder = self.checkpoint.folder
        self._check_fits()
        options: dict[str, Any] = {"dtype": self.placement.torch_dtype, "local_files_only": True}
        if self.placement.quantisation != "none":
            options["quantization_config"] = _quantisation(diffusers, self.placement)
        if self._kind.processor:
            options["processor"] = load_processor(folder / "processor", self._kind.processor)
        if self._is_direct:
            options["device_map"] = self.placement.device.partition(":")[0]  # each part as it is read
        try:
            pipeline = getattr(diffusers, self.checkpoint.kind).from_pretrained(str(folder), **options)
            if self.settings["lightning"]:
                pipeline.scheduler = diffusers.FlowMatchEulerDiscreteScheduler.from_config(LIGHTNING_SCHEDULER)
            if self._lora:
                pipeline.load_lora_weights(str(self._lora))
            supply_token_types(pipeline.text_encoder)
            pipeline.set_progress_bar_config(disable=True)
            if self._offload == "model":
                pipeline.enable_model_cpu_offload(device=self.placement.device)
            elif self._offload == "sequential":
                pipeline.enable_sequential_cpu_offload(device=self.placement.device)
            elif not self._is_direct:
                pipeline.to(self.placement.device)
        except Exception as error:
            if is_out_of_memory(error):
                raise ResourceError(f"{str(folder)!r} does not fit: {error}; set {self.shrinking[0]}") from error
            raise ModelFilesError(f"{str(folder)!r} cannot be loaded by diffusers: {str(error)[:300]}") from error
        self._model = pipeline

    @property
    def _is_direct(self) -> bool:
        """Whether the weights go part by part onto the accelerator, without being in main memory all at once."""
        return self._offload == "none" and self.placement.device not in ("cpu", "mps")

    def _check_fits(self) -> None:
        folder = self.checkpoint.folder
        if self._offload == "none":
            check_fits(folder, self.placement, shrinking=self.shrinking)
        elif self._offload == "model":
            parts = [parameter_count(part) for part in folder.iterdir() if part.is_dir()]
            check_fits(folder, self.placement, largest_part=max(parts) / sum(parts), shrinking=self.shrinking)
        if self._offload != "none":
            in_main_memory = replace(self.placement, device="cpu")
            check_fits(folder, in_main_memory, shrinking=(QUANTISE,))

    def _edit(self, requests: Sequence[EditRequest]) -> list[EditAnswer]:
        return [self._edit_one(request) for request in requests]

    def _edit_one(self, request: EditRequest) -> EditAnswer:
        torch: Any = require("torch", extra="local")
        watch = Stopwatch()
        steps, scale = int(self.settings["steps"]), float(self.settings[self._kind.scale])
        width, height = output_size(request.image.size, int(self.settings["output_pixels"]))

        def on_step_end(pipeline: Any, step: int, timestep: Any, tensors: dict[str, Any]) -> dict[str, Any]:
            if request.on_step is not None:
                request.on_step(step + 1, steps)
            return tensors

        guidance: dict[str, Any] = {self._kind.scale: scale}
        if self._kind.negative_prompt is not None and scale > 1:
            guidance["negative_prompt"] = self.settings["negative_prompt"]
        picture = self._model(
            image=[request.image],
            prompt=request.prompt,
            **guidance,
            num_inference_steps=steps,
            width=width,
            height=height,
            generator=torch.Generator("cpu").manual_seed(request.seed),  # on the CPU: the same noise on any device
            callback_on_step_end=on_step_end,
        ).images[0]
        return EditAnswer(load_image(picture), usage=watch.usage(1))  # Qwen-Image 2.1 draws transparency, too


def _check_placement(placement: Placement, offload: str) -> None:
    if placement.device == SPREAD:
        raise ConfigError("qwen-image-edit cannot be spread over devices; use offload = 'model'")
    if offload not in OFFLOADS:
        raise UnknownNameError.of("offload", offload, OFFLOADS)
    if offload != "none" and placement.device == "cpu":
        raise ConfigError(f"offload = {offload!r} moves weights from an accelerator to the CPU, and there is none here")
    if placement.quantisation != "none" and placement.device == "cpu":
        raise ConfigError(
            f"quantisation = {placement.quantisation!r} of the editor needs a GPU, and there is none here"
        )


def output_size(size_wh: tuple[int, int], pixels: int) -> tuple[int, int]:
    """(width, height) in the proportions of `size_wh`, multiples of 32, about `pixels` in area."""
    ratio = size_wh[0] / size_wh[1]
    width = math.sqrt(pixels * ratio)
    return max(32, round(width / 32) * 32), max(32, round(width / ratio / 32) * 32)


def supply_token_types(text_encoder: Any) -> None:
    """Tell the text encoder which tokens are of the image, where the pipeline does not.

    Without `mm_token_type_ids`, Qwen2.5-VL of transformers 5 gives every token a one-dimensional position and
    says nothing (diffusers issue 14194). A pipeline that passes them is left alone.
    """
    if "mm_token_type_ids" not in inspect.signature(text_encoder.forward).parameters:
        return

    def before_forward(module: Any, args: Any, kwargs: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        if kwargs.get("image_grid_thw") is not None and kwargs.get("mm_token_type_ids") is None:
            kwargs["mm_token_type_ids"] = (kwargs["input_ids"] == module.config.image_token_id).int()
        return args, kwargs

    text_encoder.register_forward_pre_hook(before_forward, with_kwargs=True)


def _quantisation(diffusers: Any, placement: Placement) -> Any:
    bits: dict[str, Any] = {"load_in_8bit": True}
    if placement.quantisation == "4bit":
        bits = {"load_in_4bit": True, "bnb_4bit_quant_type": "nf4", "bnb_4bit_compute_dtype": placement.torch_dtype}
    return diffusers.quantizers.PipelineQuantizationConfig(
        quant_backend=f"bitsandbytes_{placement.quantisation}",
        quant_kwargs=bits,
        components_to_quantize=QUANTISED_PARTS,
    )


create = DiffusersEditor
