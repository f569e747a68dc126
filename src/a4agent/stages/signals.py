"""What can be measured of an answer without knowing the truth. Each signal is a small class behind one protocol.

A package adds one with an entry point of the group `a4agent.signals`; a profile lists those it wants by name:

    [project.entry-points."a4agent.signals"]            [verifier]
    symmetry = "my_package.signals:Symmetry"            signals = ["geometry", "symmetry"]

    class Symmetry:
        name, needs = "symmetry", ()
        def measure(self, evidence: Evidence) -> list[Check]: ...
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import numpy as np
from PIL import ImageFilter
from PIL.Image import Image, Transpose

from a4agent.imaging.masks import box_iou, iou, tight_box
from a4agent.plugins import Plugins
from a4agent.protocols import Detector, Segmenter, VisionLanguageModel
from a4agent.stages.recorder import Recorder
from a4agent.stages.spotter import Spotter
from a4agent.types import Affordance, Check, Region, Target

signals = Plugins("a4agent.signals", "signal")


@dataclass(frozen=True, eq=False)
class Evidence:
    """What a signal may look at: the answer so far (with its picture) and the experts that can be asked again.

    Calls go through `recorder`, so that each is a step of the trace, cached and priced. `vlm`, `detector` and
    `segmenter` are the Verifier's own.
    """

    affordance: Affordance
    spotter: Spotter
    recorder: Recorder
    vlm: VisionLanguageModel | None = None
    detector: Detector | None = None
    segmenter: Segmenter | None = None
    prompts: str = "verifier"
    max_tokens: int = 1024

    @property
    def image(self) -> Image:
        assert self.affordance.image is not None
        return self.affordance.image

    def locate(self, image: Image, phrase: str, spotter: Spotter | None = None) -> np.ndarray:
        """The mask (H, W) bool that the Spotter, or another one, finds for a phrase in a picture."""
        regions = (spotter or self.spotter).locate(image, phrase, self.recorder, stage="verifier")
        blank = np.zeros((image.height, image.width), bool)
        return np.logical_or.reduce([blank, *(region.mask for region in regions)])


class Signal(Protocol):
    """Measures one thing about an answer. `needs` names the verifier's experts it asks ("vlm", "detector", ...).

    `measure` may raise: an error that concerns this sample alone makes the check's value None.
    """

    @property
    def name(self) -> str: ...
    @property
    def needs(self) -> tuple[str, ...]: ...

    def measure(self, evidence: Evidence) -> Sequence[Check]:
        """One check for each value; names are the same for every answer."""
        ...


class MaskGeometry:
    """Whether point, box and mask fit together and the mask has a plausible size. Asks nobody."""

    name: ClassVar[str] = "geometry"
    needs: ClassVar[tuple[str, ...]] = ()
    LEAST, MOST = 0.0005, 0.6
    """Shares of the picture that a part plausibly covers."""

    def measure(self, evidence: Evidence) -> list[Check]:
        regions = evidence.affordance.regions
        points = [_share_inside(region.mask, region.points_xy) for region in regions if len(region.points_xy)]
        boxes = [(r.box_xyxy, r.tight_box_xyxy) for r in regions if r.box_xyxy is not None]
        fits = [0.0 if tight is None else float(box_iou(box, tight)) for box, tight in boxes]
        share = float(evidence.affordance.mask.mean())
        plausible = min(1.0, share / self.LEAST, (1 - share) / (1 - self.MOST))
        return [
            _check(
                "point_in_mask", _mean(points), "{:.0%} of the key points lie in the mask", "there are no key points"
            ),
            _check("mask_in_box", _mean(fits), "mask and box overlap by {:.0%}", "no box"),
            Check("plausible_area", plausible, f"the mask covers {share:.1%} of the picture", "spotter"),
        ]


class PredictedIou:
    """What the segmenter expects its mask to reach. Asks nobody."""

    name: ClassVar[str] = "predicted_iou"
    needs: ClassVar[tuple[str, ...]] = ()

    def measure(self, evidence: Evidence) -> list[Check]:
        known = [r.predicted_iou for r in evidence.affordance.regions if r.predicted_iou is not None]
        value = _mean([min(max(value, 0.0), 1.0) for value in known])
        return [_check(self.name, value, "the segmenter expects an IoU of {:.2f}", "the segmenter gives no estimate")]


class Score:
    """The detector's own score. Asks nobody."""

    name: ClassVar[str] = "score"
    needs: ClassVar[tuple[str, ...]] = ()

    def measure(self, evidence: Evidence) -> list[Check]:
        known = [region.score for region in evidence.affordance.regions if region.score is not None]
        value = _mean([min(max(value, 0.0), 1.0) for value in known])
        return [_check(self.name, value, "the detector's score is {:.2f}", "the detector gives no score")]


class Rewording:
    """The same part asked for in other words: the Spotter once more."""

    name: ClassVar[str] = "rewording"
    needs: ClassVar[tuple[str, ...]] = ()

    def measure(self, evidence: Evidence) -> list[Check]:
        other = reworded(evidence.affordance.phrase, evidence.affordance.target)
        value = iou(evidence.affordance.mask, evidence.locate(evidence.image, other))
        return [Check(self.name, value, f"asked for {other!r} instead, the masks overlap by {value:.0%}", "spotter")]


class SecondDetector:
    """Another detector, with the same segmenter."""

    name: ClassVar[str] = "second_detector"
    needs: ClassVar[tuple[str, ...]] = ("detector",)

    def measure(self, evidence: Evidence) -> list[Check]:
        assert evidence.detector is not None
        other = replace(evidence.spotter, detector=evidence.detector)
        value = iou(evidence.affordance.mask, evidence.locate(evidence.image, evidence.affordance.phrase, other))
        return [Check(self.name, value, f"the mask by {evidence.detector.id} overlaps by {value:.0%}", "spotter")]


class SecondSegmenter:
    """Another segmenter, prompted with the boxes and points of the answer."""

    name: ClassVar[str] = "second_segmenter"
    needs: ClassVar[tuple[str, ...]] = ("segmenter",)

    def measure(self, evidence: Evidence) -> list[Check]:
        assert evidence.segmenter is not None
        other = replace(evidence.spotter, segmenter=evidence.segmenter)
        regions = other.segment_again(evidence.image, evidence.affordance.regions, evidence.recorder, stage="verifier")
        value = iou(evidence.affordance.mask, replace(evidence.affordance, regions=regions).mask)
        return [Check(self.name, value, f"the mask by {evidence.segmenter.id} overlaps by {value:.0%}", "spotter")]


class Mirror:
    """The mirrored picture: the Spotter once more; "left" and "right" change places in the phrase."""

    name: ClassVar[str] = "mirror"
    needs: ClassVar[tuple[str, ...]] = ()

    def measure(self, evidence: Evidence) -> list[Check]:
        mirrored = evidence.image.transpose(Transpose.FLIP_LEFT_RIGHT)
        found = evidence.locate(mirrored, _sides_swapped(evidence.affordance.phrase))
        value = iou(evidence.affordance.mask, found[:, ::-1])
        return [Check(self.name, value, f"in the mirrored picture the masks overlap by {value:.0%}", "spotter")]


class Crop:
    """A crop about the mask, with half its size around it: the Spotter once more."""

    name: ClassVar[str] = "crop"
    needs: ClassVar[tuple[str, ...]] = ()

    def measure(self, evidence: Evidence) -> list[Check]:
        mask = evidence.affordance.mask
        frame = crop_around(mask, margin=0.5)
        if frame is None:
            return [Check(self.name, None, "a crop would be the whole picture")]
        x0, y0, x1, y1 = frame
        found = evidence.locate(evidence.image.crop(frame), evidence.affordance.phrase)
        value = iou(mask[y0:y1, x0:x1], found)
        return [Check(self.name, value, f"in a crop about it the masks overlap by {value:.0%}", "spotter")]


class ImaginedChange:
    """How much of the mask lies where the Dreamer changed the picture: hands go to the part to act on. Asks nobody."""

    name: ClassVar[str] = "imagined_change"
    needs: ClassVar[tuple[str, ...]] = ()
    MOST = 0.6
    """An edit that changes more of the picture than this shows no place."""

    def measure(self, evidence: Evidence) -> list[Check]:
        imagination = evidence.affordance.imagination
        if imagination is None or imagination.image is None:
            return [Check(self.name, None, "nothing was imagined")]
        changed = changed_area(evidence.image, imagination.image)
        if not 0 < changed.mean() <= self.MOST:
            return [Check(self.name, None, f"the imagined picture differs in {changed.mean():.0%} of its area")]
        mask = evidence.affordance.mask
        value = float((mask & changed).sum() / max(int(mask.sum()), 1))
        return [Check(self.name, value, f"the imagined interaction touches {value:.0%} of the mask", "dreamer")]


def locate_differently(
    spotter: Spotter, answer: Affordance, recorder: Recorder, retry: int
) -> tuple[Region, ...] | None:
    """The regions by asking a rejected answer's part in other words (first retry) or in a crop (second).

    None when there is no such way to ask.

    Raises:
        ProviderError: a model could not be asked.
    """
    assert answer.image is not None
    if retry == 1:
        return spotter.locate(answer.image, reworded(answer.phrase, answer.target), recorder)
    frame = crop_around(answer.mask, margin=1.0) if retry == 2 else None
    if frame is None:
        return None
    regions = spotter.locate(answer.image.crop(frame), answer.phrase, recorder)
    return tuple(_moved(region, frame, answer.mask.shape) for region in regions)


def _moved(region: Region, frame: tuple[int, int, int, int], shape: tuple[int, ...]) -> Region:
    """A region of a crop as one of the whole picture."""
    x0, y0, x1, y1 = frame
    mask = np.zeros(shape, bool)
    mask[y0:y1, x0:x1] = region.mask
    corner = np.array([x0, y0], np.float32)
    box = None if region.box_xyxy is None else region.box_xyxy + np.tile(corner, 2)
    return replace(region, box_xyxy=box, points_xy=region.points_xy + corner, mask=mask)


def reworded(phrase: str, target: Target | None = None) -> str:
    """The part in other words: "the handle of the mug" <-> "mug handle", "the knob" -> "the knob of the drawer"."""
    bare = " ".join(phrase.split()).removeprefix("the ")
    found = re.fullmatch(r"(.+?) of (?:the |a |an )?(.+)", bare)
    if found:
        return f"{found[2]} {found[1]}"
    name = target.object_name.strip().lower() if target else ""
    if name and bare.lower().endswith(name):
        return bare if bare != phrase else f"the {bare}"
    if name and bare.lower().startswith(f"{name} "):
        return f"the {bare[len(name) + 1 :]} of the {name}"
    if name:
        return f"the {bare} of the {name}"
    return bare if bare != phrase else f"the {bare}"


def crop_around(mask: np.ndarray, margin: float) -> tuple[int, int, int, int] | None:
    """A frame (x0, y0, x1, y1) around a mask, wider by `margin` of its sides; None if it is most of the picture."""
    box = tight_box(mask)
    if box is None:
        return None
    height, width = mask.shape
    side = np.tile(margin * np.maximum(box[2:] - box[:2], 16), 2) * [-1, -1, 1, 1]
    x0, y0, x1, y1 = (int(edge) for edge in np.clip(box + side, 0, [width, height, width, height]))
    return None if (x1 - x0) * (y1 - y0) > 0.8 * width * height else (x0, y0, x1, y1)


def changed_area(photo: Image, edited: Image) -> np.ndarray:
    """Where (H, W) bool an edited picture differs from the photograph by more than it does everywhere."""
    blur = ImageFilter.GaussianBlur(max(photo.size) / 100)
    before, after = (np.asarray(p.convert("RGB").resize(photo.size).filter(blur), np.float32) for p in (photo, edited))
    difference = np.abs(after - before).mean(2)
    return difference > np.median(difference) + 16


def _sides_swapped(phrase: str) -> str:
    swap = {"left": "right", "right": "left"}
    return re.sub(r"\b(left|right)", lambda found: swap[found[1]], phrase)


def _share_inside(mask: np.ndarray, points_xy: np.ndarray) -> float:
    """The share of points (k, 2) that lie in a mask."""
    height, width = mask.shape
    columns, rows = np.clip(np.floor(points_xy), 0, [width - 1, height - 1]).astype(int).T
    return float(mask[rows, columns].mean())


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _check(name: str, value: float | None, note: str, unknown: str) -> Check:
    return Check(name, None, unknown) if value is None else Check(name, value, note.format(value), "spotter")
