"""How well a profile finds the part to act on in a folder of real photographs with part masks.

    python perf/real_photos.py --data FOLDER [--profile offline] [--set NAME=VALUE] [--sheet out.png] [--variants]
                               [--pairs]

FOLDER holds `samples.jsonl`; each line names an image, a mask (both relative to the folder) and what was
asked, and may name the object, the part and the affordance to print scores by:

    {"id": "mug_02_grasp", "image": "mug_02.jpg", "mask": "mug_02_grasp_mask.png",
     "instruction": "hang the mug on a hook", "object_name": "mug", "object_part": "the handle of the mug",
     "affordance": "grasp"}

Printed: the scores of the agent, of the Spotter alone when it is told the right part, of a baseline that
answers with the whole object, and of the agent when it is asked as UMD's published runs ask. `--sheet` draws the truth
in red and the answer in green. `--variants` asks again with each picture mirrored, turned, resized, darker, brighter
and compressed, to see what holds. `--pairs` lays two things of a kind side by side and asks for the left and the right.
"""

from __future__ import annotations

import argparse
import io
import itertools
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageEnhance, ImageOps

from a4agent import A4Agent, metrics
from a4agent.benchmarks import umd
from a4agent.types import Affordance, Given, Status, Target

TILE = 240


@dataclass(frozen=True)
class Sample:
    """One question about one photograph; `truth` (H, W) bool."""

    id: str
    image: Image.Image
    truth: np.ndarray
    instruction: str
    object_name: str
    object_part: str
    affordance: str


@dataclass(frozen=True)
class Result:
    sample: Sample
    mask: np.ndarray
    status: Status
    seconds: float

    @property
    def row(self) -> metrics.Row:
        truth = self.sample.truth
        if self.status in ("invalid", "error"):
            return metrics.Row(0, int(truth.sum()), self.status)
        return metrics.Row(int((self.mask & truth).sum()), int((self.mask | truth).sum()), self.status)

    @property
    def iou(self) -> float:
        return self.row.intersection / max(self.row.union, 1)


def read(folder: Path) -> Iterator[Sample]:
    for line in (folder / "samples.jsonl").read_text(encoding="utf-8").splitlines():
        row = json.loads(line)
        with Image.open(folder / row["image"]) as image, Image.open(folder / row["mask"]) as mask:
            truth = np.array(mask.convert("L")) > 127
            picture = ImageOps.exif_transpose(image).convert("RGB")
        name = row.get("object_name", "")
        part = row.get("object_part", "")
        yield Sample(row["id"], picture, truth, row["instruction"], name, part, row.get("affordance", ""))


def _rotated(degrees: float) -> Callable[[Sample], Sample]:
    def turn(sample: Sample) -> Sample:
        fill = tuple(int(v) for v in np.asarray(sample.image)[0, 0])
        image = sample.image.rotate(degrees, Image.Resampling.BICUBIC, expand=degrees % 90 == 0, fillcolor=fill)
        truth = Image.fromarray(sample.truth).rotate(degrees, expand=degrees % 90 == 0)
        return replace(sample, image=image, truth=np.array(truth))

    return turn


def _resized(factor: float) -> Callable[[Sample], Sample]:
    def resize(sample: Sample) -> Sample:
        size = round(sample.image.width * factor), round(sample.image.height * factor)
        truth = Image.fromarray(sample.truth).resize(size, Image.Resampling.NEAREST)
        return replace(sample, image=sample.image.resize(size, Image.Resampling.LANCZOS), truth=np.array(truth))

    return resize


def _brighter(factor: float) -> Callable[[Sample], Sample]:
    return lambda sample: replace(sample, image=ImageEnhance.Brightness(sample.image).enhance(factor))


def _cropped(sample: Sample) -> Sample:
    """Off centre: a quarter of the left and a fifth of the top are gone."""
    width, height = sample.image.size
    x, y = width // 5, height // 8
    return replace(sample, image=sample.image.crop((x, y, width, height)), truth=sample.truth[y:, x:])


def _compressed(sample: Sample) -> Sample:
    packed = io.BytesIO()
    sample.image.save(packed, "JPEG", quality=40)
    return replace(sample, image=Image.open(packed).convert("RGB"))


def _mirrored(sample: Sample) -> Sample:
    return replace(sample, image=ImageOps.mirror(sample.image), truth=sample.truth[:, ::-1])


VARIANTS: dict[str, Callable[[Sample], Sample]] = {
    "mirrored": _mirrored,
    "turned by 90": _rotated(90),
    "turned by 180": _rotated(180),
    "tilted by 20": _rotated(20),
    "half the size": _resized(0.5),
    "twice the size": _resized(2.0),
    "darker": _brighter(0.6),
    "brighter": _brighter(1.35),
    "off centre": _cropped,
    "JPEG 40": _compressed,
}


def ask(agent: A4Agent, samples: list[Sample], given: Callable[[Sample], Given] | None = None) -> list[Result]:
    results: list[Result] = []
    for sample in samples:
        started = time.perf_counter()
        answer: Affordance = agent.predict(sample.image, sample.instruction, given=given(sample) if given else None)
        results.append(Result(sample, answer.mask, answer.status, time.perf_counter() - started))
    return results


def in_umd_wording(sample: Sample) -> Sample:
    """The question that names no thing, only what the part can do."""
    return replace(sample, instruction=umd.RULES["a4"].format(affordance=sample.affordance))


def pairs(samples: list[Sample], most: int = 8) -> Iterator[Sample]:
    """The surroundings of two things of a name side by side, the grip of the left or the right one asked for."""
    rng = np.random.default_rng(3)
    by_name: dict[str, list[Sample]] = {}
    for sample in samples:
        if sample.affordance == "grasp":
            by_name.setdefault(sample.object_name, []).append(_surroundings(sample))
    for name, found in by_name.items():
        both = list(itertools.permutations(found, 2))
        for index in rng.permutation(len(both))[:most]:
            image = Image.fromarray(np.hstack([np.asarray(sample.image) for sample in both[index]]))
            for k, side in enumerate(("left", "right")):
                blank = np.zeros_like(both[index][k].truth)
                truth = np.hstack([both[index][0].truth, blank] if k == 0 else [blank, both[index][1].truth])
                instruction = f"pick up the {side} {name} by its handle"
                yield Sample(f"{name} {side}", image, truth, instruction, name, "", "grasp")


def _surroundings(sample: Sample, side: int = 320) -> Sample:
    """A square of `side` pixels with the truth in its middle, as far as the picture allows."""
    middle = np.argwhere(sample.truth).mean(0).astype(int)[::-1]
    x, y = (int(v) for v in np.clip(middle - side // 2, 0, np.maximum(np.array(sample.image.size) - side, 0)))
    box = (x, y, x + side, y + side)
    return replace(sample, image=sample.image.crop(box), truth=np.array(Image.fromarray(sample.truth).crop(box)))


def told(sample: Sample) -> Given:
    return Given(target=Target(sample.instruction, sample.object_name, sample.object_part))


def told_whole(sample: Sample) -> Given:
    return Given(target=Target(sample.instruction, sample.object_name, f"the {sample.object_name}"))


def line(name: str, results: list[Result]) -> str:
    scores = metrics.score([result.row for result in results])
    seconds = np.median([result.seconds for result in results])
    figures = f"gIoU {scores.giou:.3f}  P@50 {scores.p50:.3f}  cIoU {scores.ciou:.3f}"
    return f"{name:<34} n {len(results):>3}  {figures}  {seconds:6.2f} s"


def by(results: list[Result], name: Callable[[Sample], str]) -> Iterator[str]:
    groups: dict[str, list[Result]] = {}
    for result in results:
        groups.setdefault(name(result.sample), []).append(result)
    for group in sorted(groups):
        yield line(f"  {group}", groups[group])


def sheet(results: list[Result], columns: int = 8) -> Image.Image:
    """A tile per sample around truth and answer."""
    tiles = [_tile(result) for result in results]
    rows = -(-len(tiles) // columns)
    whole = Image.new("RGB", (columns * TILE, rows * TILE))
    for index, tile in enumerate(tiles):
        whole.paste(tile, (index % columns * TILE, index // columns * TILE))
    return whole


def _tile(result: Result) -> Image.Image:
    shown = result.sample.truth | result.mask
    rows, columns = np.flatnonzero(shown.any(1)), np.flatnonzero(shown.any(0))
    if not len(rows):
        rows, columns = np.array([0, shown.shape[0] - 1]), np.array([0, shown.shape[1] - 1])
    half = 0.7 * max(np.ptp(rows), np.ptp(columns), 16)
    x, y = (columns[0] + columns[-1]) / 2, (rows[0] + rows[-1]) / 2
    box = (round(x - half), round(y - half), round(x + half), round(y + half))
    tile = np.array(result.sample.image.crop(box).resize((TILE, TILE)))
    for mask, colour in ((result.sample.truth, (255, 0, 0)), (result.mask, (0, 255, 0))):
        inside = np.array(Image.fromarray(mask).crop(box).resize((TILE, TILE)))
        around = np.pad(inside, 1)
        core = around[:-2, 1:-1] & around[2:, 1:-1] & around[1:-1, :-2] & around[1:-1, 2:]
        tile[inside & ~core] = colour
    drawn = Image.fromarray(tile)
    ImageDraw.Draw(drawn).text((4, 3), f"{result.sample.id} {result.iou:.2f}", fill=(255, 255, 0))
    return drawn


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="a folder with samples.jsonl")
    parser.add_argument("--profile", default="offline")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a setting of the profile")
    parser.add_argument("--sheet", type=Path, help="write a contact sheet here")
    parser.add_argument("--variants", action="store_true", help="ask again with changed pictures")
    parser.add_argument("--pairs", action="store_true", help="two things side by side, told apart by their side")
    options = parser.parse_args()
    agent = A4Agent.from_profile(options.profile, dict(pair.partition("=")[::2] for pair in options.set))
    samples = list(read(options.data))

    results = ask(agent, samples)
    print(line(f"{options.profile}, the instruction", results))
    print(line("told the part", ask(agent, samples, told)))
    print(line("whole object", ask(agent, samples, told_whole)))
    print(line("in the wording of UMD", ask(agent, [in_umd_wording(sample) for sample in samples])))
    print("by object")
    print("\n".join(by(results, lambda sample: sample.object_name)))
    print("by affordance")
    print("\n".join(by(results, lambda sample: sample.affordance)))
    fresh = list({result.sample.image.tobytes(): result.seconds for result in reversed(results)}.values())
    print(f"a picture seen for the first time: {np.median(fresh):.2f} s (median of {len(fresh)})")
    if options.sheet:
        sheet(results).save(options.sheet)
        print(f"wrote {options.sheet}")
    if options.pairs:
        print(line("two side by side", ask(agent, list(pairs(samples)))))
    if options.variants:
        print("the same pictures, changed")
        for name, change in VARIANTS.items():
            print(line(f"  {name}", ask(agent, [change(sample) for sample in samples])), flush=True)


if __name__ == "__main__":
    main()
