"""The signal "recognised": does the place that was marked look like the thing that was asked for?

    recognise(image, boxes (n, 4)) -> (n, 1000) float32, the probability of each class in recogniser.txt

EfficientNet-Lite0, trained by Google on ImageNet (Apache-2.0), looks at the mask with a little and with a lot of what
is around it. recogniser.toml says which of its classes show a thing of knowledge.toml. It takes no part in the answer,
only in how far it is trusted. `perf/recogniser.py` makes its file.
"""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from a4agent.files import read_toml
from a4agent.imaging.masks import tight_box
from a4agent.offline.networks import session, softmax
from a4agent.offline.phrases import wanted
from a4agent.types import Check

if TYPE_CHECKING:
    from PIL.Image import Image

    from a4agent.stages.signals import Evidence

HERE = Path(__file__).parent
WEIGHTS = HERE / "recogniser.onnx"
SHA256 = "645918cb7a23d4e05a570d91f6ab04d6fd2063431a883d44a65df7ba7406563a"
SIDE = 224
VIEWS = (1.6, 3.2)
"""Sides of the squares that are looked at, in longer sides of the mask."""
LEAST = 1e-3
"""A probability that counts as none; a check's value is 0 here, 1 at certainty, and even in powers of ten."""
UNNAMED = ("object", "thing", "item", "tool", "")


class Recognised:
    """Two checks: the marked thing is of the named kind, or of one that looks like it. About 25 ms on one core.

    Of what ImageNet lacks ("saw") and recogniser.toml knows a likeness for, both are about that likeness.
    """

    name: ClassVar[str] = "recognised"
    needs: ClassVar[tuple[str, ...]] = ()

    def measure(self, evidence: Evidence) -> list[Check]:
        target = evidence.affordance.target
        name = target.object_name if target else wanted(evidence.affordance.phrase).object or "object"
        itself, alike = classes_of(name)
        box = tight_box(evidence.affordance.mask)
        if box is None or not (itself or alike):
            unknown = f"the recogniser does not know {name!r}"
            return [Check("thing_itself", None, unknown), Check("thing_alike", None, unknown)]
        found = recognise(evidence.image, np.stack([around(box, times) for times in VIEWS]))
        label = labels()[int(found.max(0).argmax())]
        kind = itself or ([] if bare(name) in UNNAMED else alike)
        sure = float(found[:, kind].sum(1).max()) if kind else None
        near = float(found[:, sorted({*itself, *alike})].sum(1).mean())
        shown = f"best match: {label}"
        return [
            Check("thing_itself", None if sure is None else _scaled(sure), shown),
            Check("thing_alike", _scaled(near), shown),
        ]


def recognise(image: Image, boxes_xyxy: np.ndarray) -> np.ndarray:
    """The probability (n, 1000) of each class for crops of an RGB image; what is outside of it is black.

    Raises:
        MissingExtraError: onnxruntime is not installed.
        ModelFilesError: the network's file is missing or not the one that was tested.
    """
    pixels = (np.stack([np.asarray(_cut(image, box), np.float32) for box in boxes_xyxy]) - 127) / 128
    logits: np.ndarray = session(WEIGHTS, 1, SHA256).run(["logits"], {"crops": pixels.transpose(0, 3, 1, 2)})[0]
    return softmax(logits)


def around(box_xyxy: np.ndarray, times: float) -> np.ndarray:
    """A square (4,) about a box with `times` its longer side, at least 48 pixels wide."""
    centre = (box_xyxy[:2] + box_xyxy[2:]) / 2
    half = max(float((box_xyxy[2:] - box_xyxy[:2]).max()) * times, 48.0) / 2
    return np.concatenate([centre - half, centre + half])


@lru_cache(maxsize=256)
def classes_of(name: str) -> tuple[list[int], list[int]]:
    """Which classes show a thing, and which look like it; both empty for what ImageNet and recogniser.toml lack.

    A name that ends with a class's ("tennis racket") is of that class. Of a thing without a name ("object") all classes
    that recogniser.toml knows look like it.
    """
    tables = read_toml(HERE / "recogniser.toml")
    number = {label: i for i, label in reversed(list(enumerate(labels())))}
    name = bare(name)

    def numbers(words: list[str]) -> list[int]:
        flat = [one for word in words for one in (tables["groups"][word[1:]] if word[0] == "@" else [word])]
        return sorted({number[label] for label in flat})

    if name in UNNAMED:
        return [], sorted({i for row in tables["things"].values() for i in numbers([*row["is"], *row["like"]])})
    if name in tables["things"]:
        return numbers(tables["things"][name]["is"]), numbers(tables["things"][name]["like"])
    return [i for i, label in enumerate(labels()) if _ends_alike(label.lower(), name)], []


def bare(name: str) -> str:
    """ "The Mug" -> "mug"."""
    return re.sub(r"^(?:the|a|an) ", "", name.strip().lower())


@lru_cache(maxsize=1)
def labels() -> list[str]:
    """The names of the 1,000 classes, in the order of the network."""
    return (HERE / "recogniser.txt").read_text(encoding="utf-8").splitlines()


def _ends_alike(label: str, name: str) -> bool:
    return f" {label}".endswith(f" {name}") or f" {name}".endswith(f" {label}")


def _cut(image: Image, box_xyxy: np.ndarray) -> Image:
    shrink = int(box_xyxy[2] - box_xyxy[0]) // (4 * SIDE)
    if shrink > 1:  # a crop takes its whole size in memory, and Pillow refuses very large ones
        image, box_xyxy = image.reduce(shrink), box_xyxy / shrink
    return image.crop(tuple(int(edge) for edge in box_xyxy)).resize((SIDE, SIDE))  # type: ignore[arg-type]


def _scaled(probability: float) -> float:
    return float(np.clip(1 - np.log10(max(probability, LEAST)) / np.log10(LEAST), 0.0, 1.0))
