"""A small benchmark of drawn pictures, and an agent whose answers depend on the picture alone.

The part of every picture is a red rectangle; its number stands in the first pixel. By its number a sample
is answered well, wrongly placed, with nothing, unreadably or with an error.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from a4agent.agent import A4Agent
from a4agent.errors import RequestRejected
from a4agent.protocols import ChatAnswer, ChatRequest, DetectRequest
from a4agent.stages.dreamer import Dreamer
from a4agent.stages.spotter import Spotter
from a4agent.stages.thinker import Thinker
from a4agent.testing import ScriptedDetector, ScriptedEditor, ScriptedSegmenter, ScriptedVLM, output
from a4agent.types import Detection, Usage

WIDTH, HEIGHT = 96, 72
STATUSES = {0: "error", 1: "invalid", 2: "empty"}
"""By number modulo 10; all others are "ok"."""


def write_folder(folder: Path, count: int = 20, first: int = 0) -> Path:
    """A benchmark `folder` of `count` samples; the truth of the last one is empty."""
    folder.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for number in range(first, first + count):
        random = np.random.default_rng(number)
        pixels = random.integers(60, 120, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        x, y = random.integers(5, 50), random.integers(5, 40)
        width, height = random.integers(12, 40), random.integers(10, 28)
        truth = np.zeros((HEIGHT, WIDTH), dtype=bool)
        truth[y : y + height, x : x + width] = True
        pixels[truth] = (250, 0, 0)
        pixels[0, 0] = (number, 200, 200)
        Image.fromarray(pixels).save(folder / f"{number}.png")
        if number == first + count - 1:
            truth[:] = False
        Image.fromarray(truth.astype(np.uint8) * 255).save(folder / f"{number}_mask.png")
        rows.append(
            {
                "id": f"picture {number}",
                "image": f"{number}.png",
                "mask": f"{number}_mask.png",
                "instruction": f"touch the red part, number {number}",
                "object_name": "board",
                "object_part": "the red part of the board",
                "category": f"kind {number % 3}",
            }
        )
    (folder / "samples.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def agent(seconds: float = 0.0, *, dream: bool = True, shift: int = 0, **more: Any) -> A4Agent:
    """The agent; `shift` moves every box to the right, `seconds` is what each model call takes."""
    more = {"seconds": seconds, "concurrency": 2, **more}
    vlm = ScriptedVLM(_think, id="scripted:vlm", **more)
    dreamer = Dreamer(vlm, ScriptedEditor(id="scripted:editor", **more)) if dream else None
    detector = ScriptedDetector(lambda request: _detect(request, shift), id=f"scripted:detector-{shift}", **more)
    segmenter = ScriptedSegmenter(id="scripted:segmenter", **more)
    return A4Agent(dreamer, Thinker(vlm, reasks=0), Spotter(detector, segmenter))


def number_of(image: Image.Image) -> int:
    return image.getpixel((0, 0))[0]  # type: ignore[index]


def _think(request: ChatRequest) -> ChatAnswer:
    usage = Usage(tokens_in=100, tokens_out=20, cost=0.01)
    if "### Output" not in request.text:
        return ChatAnswer("Paint a hand on the <b>red</b> part.", usage=usage)
    if STATUSES.get(number_of(request.images[0]) % 10) == "invalid":
        return ChatAnswer("no idea", usage=usage)
    return ChatAnswer(output("the red part of the board", thinking="It is red.</script><b>&amp;"), usage=usage)


def _detect(request: DetectRequest, shift: int) -> Any:
    number = number_of(request.image)
    status = STATUSES.get(number % 10)
    if status == "error":
        return RequestRejected(f"picture {number} is not welcome")
    if status == "empty":
        return Detection()
    pixels = np.asarray(request.image)
    rows, columns = np.nonzero((pixels[..., 0] > 240) & (pixels[..., 1] < 10))
    move = shift + number % 7
    box = [[columns.min() + move, rows.min(), columns.max() + 1 + move, rows.max() + 1]]
    return Detection(np.array(box, np.float32), np.array([[columns.mean() + move, rows.mean()]], np.float32))
