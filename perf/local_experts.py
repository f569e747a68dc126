"""Time and peak memory of every local expert with random weights, of the published sizes or tiny.

    python perf/local_experts.py --size full                    on a GPU: all experts, one after the other
    python perf/local_experts.py --size tiny                    anywhere: that all of it runs
    python perf/local_experts.py --size full --only sam2 rex-omni --set rex-omni.quantisation=4bit

Weights are saved and loaded again through the path that users take; the editor's take 58 GB of disk. Answers of
random weights mean nothing and end at random, so generation is given per token. "first" includes what a device
does once; "then" is the best of `--repeat`. Memory is the device's peak (on a CPU: of the process so far).
"""

from __future__ import annotations

import argparse
import contextlib
import platform
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from a4agent import protocols as base
from a4agent.errors import A4Error
from a4agent.experts import registry
from full_sizes import save

TOKENS = 128


@dataclass(frozen=True)
class Case:
    """An expert, the checkpoint it takes, and how many requests to send at once."""

    provider: str
    checkpoint: str
    role: base.Role
    batch: int
    settings: dict[str, Any]


CASES = [
    Case("sam2", "sam2", "segmenter", 4, {"cached_images": 0}),
    Case("sam3", "sam3", "detector", 4, {}),
    Case("sam3-segmenter", "sam3_tracker", "segmenter", 4, {"cached_images": 0}),
    Case("grounding-dino", "grounding_dino", "detector", 4, {}),
    Case("owlv2", "owlv2", "detector", 4, {}),
    Case("rex-omni", "rex_omni", "detector", 2, {"max_new_tokens": TOKENS}),
    Case("transformers", "qwen_vl", "vlm", 4, {}),
    Case("qwen-image-edit", "qwen_image_edit", "editor", 1, {}),
]
TINY = {"qwen-image-edit": {"steps": 2, "output_pixels": 64 * 64}}


def photo(seed: int, size: str) -> Image.Image:
    width, height = (1024, 768) if size == "full" else (96, 64)
    return Image.fromarray(np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8))


def requests(case: Case, size: str) -> list[Any]:
    images = [photo(seed, size) for seed in range(case.batch)]
    if case.role == "vlm":
        return [base.ChatRequest((image, image), "Which part is held? " * 20, max_tokens=TOKENS) for image in images]
    if case.role == "editor":
        return [base.EditRequest(image, "Show a hand gripping the handle of the mug.") for image in images]
    if case.role == "detector":
        return [base.DetectRequest(image, "the handle of the mug") for image in images]
    box, point = np.array([10, 10, 60, 50], np.float32), np.array([[30, 30]], np.float32)
    return [base.SegmentRequest(image, (base.Prompt(box, point),) * 4) for image in images]


@contextlib.contextmanager
def made_on(device: str, size: str) -> Iterator[None]:
    """Random weights come fast on a GPU, and in bfloat16 they are half as large on disk."""
    if size == "tiny" or device == "cpu":
        yield
        return
    torch.set_default_dtype(torch.bfloat16)
    try:
        with torch.device(device):
            yield
    finally:
        torch.set_default_dtype(torch.float32)
        torch.cuda.empty_cache()


def shrink_reference_pictures() -> None:
    """The pipeline brings its input to 1024 x 1024 whatever the weights; a tiny one on a CPU would take minutes."""
    from diffusers.pipelines.qwenimage import pipeline_qwenimage_edit_plus as module

    module.VAE_IMAGE_SIZE = module.CONDITION_IMAGE_SIZE = 112 * 112


def timed(call: Any) -> tuple[float, Any]:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    started = time.perf_counter()
    answer = call()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter() - started, answer


def peak_gb() -> float:
    if torch.cuda.is_available():
        return torch.cuda.max_memory_allocated() / 1e9
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e9 if sys.platform == "darwin" else 1e6)


def measure(case: Case, folder: Path, options: argparse.Namespace, device: str) -> None:
    with made_on(device, options.size):
        seconds, _ = timed(lambda: save(case.checkpoint, folder, options.size))
    print(f"{case.provider}: random weights saved in {seconds:.0f} s", file=sys.stderr)
    if options.size == "tiny" and case.role == "editor":
        shrink_reference_pictures()
    settings = {**case.settings, **(TINY.get(case.provider, {}) if options.size == "tiny" else {})}
    settings |= {"max_batch": case.batch} if case.role != "editor" else {}
    settings |= options.set.get(case.provider, {})
    provider = case.provider.removesuffix("-segmenter")
    expert: Any = registry.create(f"{provider}:{folder}", case.role, {"device": device, **settings})
    load, _ = timed(expert.load)
    weights = peak_gb()
    asked = requests(case, options.size)
    first, answers = timed(lambda: base.ask(expert, asked))
    then = min(timed(lambda: base.ask(expert, asked))[0] for _ in range(options.repeat))
    expert.close()
    print(
        f"| {case.provider} | {case.batch} | {load:.1f} | {weights:.1f} | {first:.2f} | {then:.2f} | {peak_gb():.1f} | "
        f"{tokens(answers, then)} |",
        flush=True,
    )


def tokens(answers: Sequence[base.Answer | A4Error], seconds: float) -> str:
    errors = sorted({type(answer).__name__ for answer in answers if isinstance(answer, A4Error)})
    count = sum(answer.usage.tokens_out for answer in answers if not isinstance(answer, A4Error))
    return ", ".join([*errors, *([f"{count} tokens, {count / seconds:.0f} a second"] if count else [])])


def parse_set(pairs: Sequence[str]) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {}
    for pair in pairs:
        name, _, value = pair.partition("=")
        provider, _, setting = name.partition(".")
        found.setdefault(provider, {})[setting] = int(value) if value.isdigit() else value
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", choices=["tiny", "full"], default="tiny")
    parser.add_argument("--only", nargs="+", choices=[case.provider for case in CASES])
    parser.add_argument("--set", nargs="+", default=[], metavar="EXPERT.SETTING=VALUE")
    parser.add_argument("--repeat", type=int, default=2)
    parser.add_argument("--folder", type=Path, help="where the weights are kept meanwhile")
    options = parser.parse_args()
    options.set = parse_set(options.set)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    name = torch.cuda.get_device_name() if device == "cuda" else platform.processor() or platform.machine()
    print(f"{name}, torch {torch.__version__}, {options.size} random weights\n")
    print("| expert | requests | load s | weights GB | first s | then s | peak GB | |")
    print("|---|---|---|---|---|---|---|---|")
    for case in CASES:
        if options.only and case.provider not in options.only:
            continue
        if torch.cuda.is_available():
            torch.cuda.reset_peak_memory_stats()
        folder = Path(tempfile.mkdtemp(dir=options.folder))
        try:
            measure(case, folder / case.checkpoint, options, device)
        finally:
            shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
