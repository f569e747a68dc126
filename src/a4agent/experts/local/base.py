"""What all experts in this process share: device, number format, and what happens when memory runs out.

placement = place(device="auto", dtype="auto")           # cuda, bfloat16   or   cpu, float32
model = load_pretrained(Sam2Model, checkpoint, placement)
class Sam2(LocalExpert): ...                             # loads at the first request, halves a batch that does not fit
"""

from __future__ import annotations

import gc
import sys
import threading
import time
import warnings
from collections.abc import Callable, Generator, Hashable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from a4agent.errors import (
    A4Error,
    ConfigError,
    ModelFilesError,
    OutOfMemory,
    ProviderError,
    ResourceError,
    UnknownNameError,
    require,
)
from a4agent.experts.local.checkpoints import Checkpoint, parameter_count
from a4agent.protocols import ExpertBase
from a4agent.types import Usage

DTYPES = ("auto", "bfloat16", "float16", "float32")
QUANTISATIONS = ("none", "8bit", "4bit")
SPREAD = "spread"
QUANTISE = "quantisation = '4bit'"
_BYTES = {"float32": 4.0, "bfloat16": 2.0, "float16": 2.0, "8bit": 1.1, "4bit": 0.6}
_TOLERATED_MISSING = 0.1

RequestT = TypeVar("RequestT")
AnswerT = TypeVar("AnswerT")


@dataclass(frozen=True)
class Placement:
    """A model's device and number format. `device` is a torch device's name, or "spread" over all of them."""

    device: str
    dtype: str
    attention: str = "auto"
    quantisation: str = "none"

    @property
    def torch_dtype(self) -> Any:
        return getattr(require("torch", extra="local"), self.dtype)

    @property
    def input_device(self) -> str:
        """The device that a spread model takes its inputs on, else the device itself."""
        return best_device() if self.device == SPREAD else self.device

    def changes_answers(self) -> dict[str, str]:
        """The settings that change an answer, for fingerprints."""
        return {"dtype": self.dtype, "attention": self.attention, "quantisation": self.quantisation}


def best_device() -> str:
    """The accelerator that torch sees ("cuda", "mps", "xpu"), else "cpu"."""
    torch: Any = require("torch", extra="local")
    return str(torch.accelerator.current_accelerator().type) if torch.accelerator.is_available() else "cpu"


def place(device: str = "auto", dtype: str = "auto", attention: str = "auto", quantisation: str = "none") -> Placement:
    """Settle on a device and a number format: the accelerator in bfloat16 if there is one, else the CPU in float32.

    Raises:
        UnknownNameError: a value that is not one of those known.
        ConfigError: the device is not in this machine, or its torch cannot use it.
        MissingExtraError: torch, or what quantisation needs, is not installed.
    """
    torch: Any = require("torch", extra="local")
    if dtype not in DTYPES:
        raise UnknownNameError.of("dtype", dtype, DTYPES)
    if quantisation not in QUANTISATIONS:
        raise UnknownNameError.of("quantisation", quantisation, QUANTISATIONS)
    if quantisation != "none":
        require("bitsandbytes", extra="quantisation")
    if device == "auto":
        device = best_device()
    elif device != SPREAD:
        try:
            kind = torch.device(device).type
            torch.empty(0, device=device)
        except (RuntimeError, AssertionError, NotImplementedError) as error:
            raise ConfigError(
                f"device {device!r} cannot be used here ({str(error).splitlines()[0]}); "
                f"torch {torch.__version__} sees {best_device()!r}"
            ) from error
        device = "cpu" if kind == "cpu" else device
    if dtype == "auto":
        dtype = "float32" if device == "cpu" else "bfloat16"
    return Placement(device, dtype, attention, quantisation)


def free_bytes(device: str) -> int:
    """The memory that new weights could take on a device ("spread": on all of them and the CPU)."""
    torch: Any = require("torch", extra="local")
    psutil: Any = require("psutil", extra="local")
    on_cpu = int(psutil.virtual_memory().available)
    if device == SPREAD:
        return on_cpu + sum(torch.cuda.mem_get_info(k)[0] for k in range(torch.cuda.device_count()))
    if device.startswith("cuda"):
        unused = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return int(torch.cuda.mem_get_info(device)[0]) + int(unused)
    return on_cpu  # on mps the memory is shared


def check_fits(folder: Path, placement: Placement, *, largest_part: float = 1.0, shrinking: Sequence[str] = ()) -> None:
    """Compare what a checkpoint's weights need with what is free.

    Args:
        folder: the checkpoint.
        placement: where it is to go.
        largest_part: the share of the weights that is there at once.
        shrinking: the expert's settings with which it needs less, to be named where it does not fit.

    Raises:
        ResourceError: they do not fit.
    """
    count = parameter_count(folder)
    needed = (
        count * largest_part * _BYTES[placement.dtype if placement.quantisation == "none" else placement.quantisation]
    )
    free = free_bytes(placement.device)
    if needed <= free:
        return
    ways = ["a smaller model", *_applicable(shrinking, placement), "another device"]
    raise ResourceError(
        f"the weights of {str(folder)!r} need {_gb(needed)} GB as {placement.dtype}"
        f"{'' if placement.quantisation == 'none' else ' in ' + placement.quantisation} and {_gb(free)} GB are free "
        f"on {placement.device!r}: choose {', '.join(ways[:-1])} or {ways[-1]}"
    )


def _applicable(shrinking: Sequence[str], placement: Placement) -> list[str]:
    return [way for way in shrinking if way != QUANTISE or placement.quantisation != "4bit"]


def load_pretrained(
    cls: Any,
    checkpoint: Checkpoint,
    placement: Placement,
    shrinking: Sequence[str] = (),
    trust_remote_code: bool = False,
) -> Any:
    """`cls.from_pretrained` of a checkpoint's folder, on its device and ready to answer.

    `shrinking` names the expert's settings with which it needs less memory. `trust_remote_code` runs code that lies in
    the folder.

    Raises:
        ResourceError: the weights do not fit the device.
        ModelFilesError: the files are damaged or belong to another architecture.
        ConfigError: the attention or quantisation asked for is not available, or a package that it needs.
    """
    check_fits(checkpoint.folder, placement, shrinking=shrinking)
    options = _from_pretrained_options(placement)
    if trust_remote_code:
        options["trust_remote_code"] = True
    try:
        with _quiet_transformers():
            model, found = cls.from_pretrained(
                str(checkpoint.folder), local_files_only=True, output_loading_info=True, **options
            )
        if "device_map" not in options:
            model = model.to(placement.device)
    except Exception as error:
        if is_out_of_memory(error):
            raise ResourceError(f"{str(checkpoint.folder)!r} does not fit {placement.device!r}: {error}") from error
        if "attn_implementation" in str(error) or (isinstance(error, ImportError) and placement.attention != "auto"):
            raise ConfigError(f"attention {placement.attention!r} cannot be used: {error}") from error
        if isinstance(error, ImportError):
            raise ConfigError(f"{str(checkpoint.folder)!r} needs a package that is not installed: {error}") from error
        raise ModelFilesError(f"{str(checkpoint.folder)!r} cannot be loaded as {cls.__name__}: {error}") from error
    _check_nothing_invented(checkpoint, model, found)
    return model.eval()


@contextmanager
def _quiet_transformers() -> Generator[None, None, None]:
    """Silence its warnings about unused weights, such as a video model's; `_check_nothing_invented` checks instead."""
    logging: Any = require("transformers.utils.logging", extra="local")
    before = logging.get_verbosity()
    logging.set_verbosity_error()
    try:
        yield
    finally:
        logging.set_verbosity(before)


def _from_pretrained_options(placement: Placement) -> dict[str, Any]:
    options: dict[str, Any] = {"dtype": placement.torch_dtype}
    if placement.attention != "auto":
        options["attn_implementation"] = placement.attention
    if placement.quantisation != "none":
        transformers: Any = require("transformers", extra="local")
        options["quantization_config"] = transformers.BitsAndBytesConfig(
            load_in_8bit=placement.quantisation == "8bit",
            load_in_4bit=placement.quantisation == "4bit",
            bnb_4bit_quant_type="nf4",
            bnb_4bit_compute_dtype=placement.torch_dtype,
        )
    if placement.device == SPREAD:
        options["device_map"] = "auto"
    elif placement.device != "cpu" or placement.quantisation != "none":
        options["device_map"] = {"": placement.device}
    return options


def _check_nothing_invented(checkpoint: Checkpoint, model: Any, found: Mapping[str, Any]) -> None:
    """Transformers silently initialises missing weights at random, which makes the answers worthless."""
    missing = sorted(found.get("missing_keys", ()))
    if not missing:
        return
    total = max(1, len(model.state_dict()))
    message = f"{str(checkpoint.folder)!r} lacks {len(missing)} of {total} weights, {missing[0]!r} first"
    if len(missing) > _TOLERATED_MISSING * total:
        raise ModelFilesError(f"{message}: it is not complete, or of another architecture")
    warnings.warn(f"{message}; they are random now", stacklevel=3)


def is_out_of_memory(error: BaseException) -> bool:
    """Whether torch (on any device) or Python ran out of memory."""
    torch: Any = require("torch", extra="local")
    if isinstance(error, torch.OutOfMemoryError | MemoryError):
        return True
    text = str(error)
    return isinstance(error, RuntimeError) and ("out of memory" in text or "can't allocate memory" in text)


def release_memory() -> None:
    """Give memory that no tensor uses back to the device."""
    gc.collect()
    torch: Any = sys.modules.get("torch")
    if torch is not None and torch.accelerator.is_available():
        torch.accelerator.empty_cache() if hasattr(torch.accelerator, "empty_cache") else torch.cuda.empty_cache()


class LocalExpert(ExpertBase):
    """An expert whose weights live in this process.

    Its files are found when it is made, so that missing ones are reported at once; its weights are loaded at the first
    request or by `load()`. A subclass loads `_model` in `_load`; `shrinking` are the settings with which it needs less
    memory.

    The first argument of a subclass is its checkpoint: a folder, or a name on the hub. Settings that subclasses share:

        revision: branch, tag or commit.
        device: "auto", a torch device, or "spread" over all GPUs and the CPU where a model can be split.
        dtype: "auto" (bfloat16 on an accelerator, float32 on a CPU), "bfloat16", "float16", "float32".
        attention: "auto" (sdpa where the model has it), "sdpa", "eager", "flash_attention_2".
        quantisation: "none", "8bit" or "4bit" (bitsandbytes).
        max_batch: the most requests at once; halved whenever memory runs out.

    Making one raises ModelFilesError (no such checkpoint, or the hub cannot be reached) and ConfigError (a setting has
    a value it does not take); its methods raise ResourceError if the weights do not fit and ProviderError if the model
    fails.
    """

    shrinking: tuple[str, ...] = ()

    def __init__(
        self, id: str, checkpoint: Checkpoint, placement: Placement, *, settings: Mapping[str, Any], max_batch: int = 1
    ) -> None:
        if max_batch < 1:
            raise ConfigError(f"max_batch of {id!r} must be at least 1, not {max_batch!r}")
        super().__init__(
            id,
            revision=checkpoint.revision,
            settings={**settings, **placement.changes_answers()},
            max_batch=max_batch,
        )
        self.checkpoint = checkpoint
        self.placement = placement
        self._lock = threading.RLock()
        self._loaded = self._closed = False
        self._fitting = max_batch
        self._model: Any = None

    def _load(self) -> None:
        raise NotImplementedError

    def _unload(self) -> None:
        self._model = None

    def load(self) -> None:
        """Load the weights now. Safe to call twice.

        Raises:
            ResourceError: they do not fit.
            ModelFilesError: the files cannot be loaded.
        """
        with self._lock:
            self._closed = False
            if not self._loaded:
                self._load()
                self._loaded = True

    def close(self) -> None:
        with self._lock:
            self._closed = True
            if self._loaded:
                self._unload()
                self._loaded = False
                release_memory()

    def _in_batches(
        self,
        requests: Sequence[RequestT],
        run: Callable[[Sequence[RequestT]], list[AnswerT] | list[AnswerT | A4Error]],
        alike: Callable[[RequestT], Hashable] = lambda request: None,
    ) -> list[AnswerT | A4Error]:
        """`run` over batches of at most `max_batch` requests that are `alike`, answers in the order of the requests.

        A batch that runs out of memory is halved, and so are all later ones.
        """
        torch: Any = require("torch", extra="local")
        groups: dict[Hashable, list[int]] = {}
        for k, request in enumerate(requests):
            groups.setdefault(alike(request), []).append(k)
        answers: dict[int, AnswerT | A4Error] = {}
        with self._lock, torch.inference_mode():
            self.load()
            for waiting in groups.values():
                while waiting:
                    batch = waiting[: self._fitting]
                    found = self._try([requests[k] for k in batch], run)
                    if found is not None:
                        answers.update(zip(batch, found, strict=True))
                        waiting = waiting[len(batch) :]
        return [answers[k] for k in range(len(requests))]

    def _try(
        self,
        batch: Sequence[RequestT],
        run: Callable[[Sequence[RequestT]], list[AnswerT] | list[AnswerT | A4Error]],
    ) -> Sequence[AnswerT | A4Error] | None:
        """The answers, or None if memory ran out and a smaller batch should be tried."""
        try:
            return run(batch)
        except A4Error:
            raise
        except Exception as error:
            if not is_out_of_memory(error):
                raise ProviderError(f"{self.id} failed: {type(error).__name__}: {error}") from error
            reason = str(error).partition("\n")[0]
        release_memory()  # out here, where the error and with it the tensors of its traceback are gone
        if len(batch) > 1:
            self._fitting = len(batch) // 2
            return None
        return [
            OutOfMemory(
                f"{self.id} ran out of memory on one request ({reason}): use "
                f"{', '.join(['a smaller image', *_applicable(self.shrinking, self.placement)])}"
                " or a device with more memory"
            )
        ]


class Stopwatch:
    """Wall time since it was made; `usage(n)` is the share of one of n requests that were answered together."""

    def __init__(self) -> None:
        self._start = time.perf_counter()

    def usage(self, shared_by: int, **fields: Any) -> Usage:
        return Usage(seconds=(time.perf_counter() - self._start) / shared_by, **fields)


def _gb(number: float) -> str:
    return f"{number / 1e9:.1f}"
