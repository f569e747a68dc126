"""Where do the points go? A stage is replaced by the truth, and what the score gains is what the stage costs.

    thinker     the phrase comes from the dataset ("the handle of the mug")
    detector    boxes and points come from the true mask, one each a connected part of it
    segmenter   the true mask itself: the ceiling that the protocol leaves

Each includes the ones before it, so that the gains add up to all that is lost.
"""

from __future__ import annotations

from typing import Any, Literal, cast, get_args

import numpy as np

from a4agent.benchmarks.base import Sample
from a4agent.errors import DataError, UnknownNameError
from a4agent.imaging.load import load_image
from a4agent.imaging.masks import deepest_point
from a4agent.metrics import nearest_neighbour
from a4agent.types import Detection, Given, Region, Target

Oracle = Literal["thinker", "detector", "segmenter"]
ORACLES: tuple[Oracle, ...] = get_args(Oracle)
SPECKLE = 0.01
"""Connected parts under this share of the largest one are drawing noise, and no box of their own."""


def oracle_of(name: str) -> Oracle:
    """The oracle of that name.

    Raises:
        UnknownNameError: there is none.
    """
    if name not in ORACLES:
        raise UnknownNameError.of("oracle", name, ORACLES)
    return name


def given_of(sample: Sample, oracle: Oracle) -> Given:
    """What an oracle run tells the agent about a sample.

    Raises:
        DataError: the dataset names no part, so that there is nothing to put in the Thinker's place.
        InputError: the picture cannot be read.
    """
    if oracle == "thinker":
        return Given(target=_target(sample))
    truth = sample.truth.mask()
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
    """A tight box and an inner point for every connected part of a mask (H, W) of bool, the largest first.

    The point is the centre of the pixel that lies deepest inside.
    """
    from scipy import ndimage

    if not mask.any():
        return Detection()
    labelled: Any = ndimage.label(mask, structure=np.ones((3, 3)))
    labels, count = labelled
    slices = ndimage.find_objects(labels)
    areas = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    boxes: list[list[float]] = []
    points: list[list[float]] = []
    for i in np.argsort(-areas, kind="stable"):
        if areas[i] < SPECKLE * areas.max():
            break
        rows, columns = slices[i]
        x, y = cast(Any, deepest_point(labels[rows, columns] == i + 1))
        boxes.append([columns.start, rows.start, columns.stop, rows.stop])
        points.append([columns.start + float(x), rows.start + float(y)])
    return Detection(np.array(boxes, np.float32).reshape(-1, 4), np.array(points, np.float32).reshape(-1, 2))


def _target(sample: Sample) -> Target:
    truth = sample.truth
    if not truth.object_part:
        raise DataError(
            f"sample {sample.id!r} names no part, so the thinker has no truth to be replaced by;"
            " use --oracle detector, or a benchmark whose samples have 'object_part'"
        )
    return Target(sample.query.instruction, truth.object_name, truth.object_part, "(from the dataset)")
