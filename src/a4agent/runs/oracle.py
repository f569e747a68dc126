"""What each stage costs: the truth replaces it, and the gain in score is its cost.

    thinker     the phrase comes from the dataset ("the handle of the mug")
    detector    a box and a point for each connected part of the true mask
    segmenter   the true mask itself: the protocol's upper limit

Each one includes those above it, so the costs add up to the whole loss.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np

from a4agent.benchmarks.base import Sample
from a4agent.errors import DataError, UnknownNameError
from a4agent.imaging.load import load_image
from a4agent.imaging.masks import deepest_point, tight_box
from a4agent.metrics import nearest_neighbour
from a4agent.types import Detection, Given, Region, Target

Oracle = Literal["thinker", "detector", "segmenter"]
ORACLES: tuple[Oracle, ...] = get_args(Oracle)
SPECKLE = 0.01
"""Connected parts smaller than this share of the largest are annotation noise and get no box."""


def oracle_of(name: str) -> Oracle:
    """The oracle of that name.

    Raises:
        UnknownNameError: no such oracle; the message suggests the nearest.
    """
    if name not in ORACLES:
        raise UnknownNameError.of("oracle", name, ORACLES)
    return name


def given_of(sample: Sample, oracle: Oracle, truth: np.ndarray) -> Given:
    """What an oracle run tells the agent about a sample with the true mask `truth` (H, W) of bool.

    Raises:
        DataError: the dataset names no part, so nothing can replace the Thinker.
        InputError: the picture cannot be read.
    """
    if oracle == "thinker":
        return Given(target=_target(sample))
    width, height = load_image(sample.query.image).size
    if truth.shape != (height, width):
        truth = nearest_neighbour(truth, (height, width))
    detection = detection_of(truth)
    target = _target(sample) if sample.truth.object_part else None
    if oracle == "detector":
        return Given(target=target, detection=detection)
    region = Region(None, detection.points_xy, truth)
    return Given(target=target, detection=detection, regions=(region,) if truth.any() else ())


def detection_of(mask: np.ndarray) -> Detection:
    """A tight box and the deepest point for every connected part of a mask (H, W) of bool, the largest first."""
    from scipy import ndimage

    labelled: Any = ndimage.label(mask, structure=np.ones((3, 3)))
    labels, count = labelled
    areas = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    boxes: list[np.ndarray | None] = []
    points: list[np.ndarray | None] = []
    for i in np.argsort(-areas, kind="stable"):
        if areas[i] < SPECKLE * areas.max():
            break
        part = labels == i + 1
        boxes.append(tight_box(part))
        points.append(deepest_point(part))
    return Detection(np.array(boxes, np.float32).reshape(-1, 4), np.array(points, np.float32).reshape(-1, 2))


def _target(sample: Sample) -> Target:
    truth = sample.truth
    if not truth.object_part:
        raise DataError(
            f"sample {sample.id!r} has no 'object_part' to replace the thinker with;"
            " use --oracle detector, or a benchmark whose samples name the part"
        )
    return Target(sample.query.instruction, truth.object_name, truth.object_part, "(from the dataset)")
