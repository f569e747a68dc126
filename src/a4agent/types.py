"""The data that flows through the agent: plain frozen values, arrays and strings.

    Affordance(
        instruction="drink from the mug",
        size_wh=(640, 480),
        imagination=None,                                   # the Dreamer did not run
        target=Target(task="drink from the mug", object_name="mug", object_part="the handle of the mug"),
        regions=(Region(box_xyxy=[402, 180, 471, 322], points_xy=[[440, 251]], mask=..., score=0.93),),
        status="ok",
        confidence=0.91,                                    # how likely the mask is right; None without a Verifier
    )

Coordinates are pixels of the original image, x to the right, y down, from the top left corner; boxes
are half-open (x1 and y1 are the first pixel outside). "Nothing found" is a `(0, 4)` array and a blank
mask, never None; a failure is an Affordance whose `status` and `error` say so.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from PIL import Image as Pillow
from PIL.Image import Image

from a4agent.errors import DataError, InputError
from a4agent.imaging import overlay
from a4agent.imaging.masks import decode_rle, encode_rle, tight_box
from a4agent.imaging.save import write_answer

Status = Literal["ok", "abstained", "empty", "invalid", "error"]
"""ok: a mask was found and, if there is a Verifier, accepted; abstained: the mask is a guess whose confidence is below
`verifier.accept`; empty: nothing was found; invalid: a model's answer was unusable; error: a stage failed."""

SCHEMA = 2


@dataclass(frozen=True, eq=False)
class Imagination:
    """How: what the Dreamer asked for and the picture it got (any size; only the Thinker looks at it)."""

    prompt: str
    image: Image | None


@dataclass(frozen=True)
class Target:
    """What: the part to act on, as the Thinker named it ("the handle of the mug")."""

    task: str
    object_name: str
    object_part: str
    thinking: str = ""


@dataclass(frozen=True)
class Check:
    """One thing that the Verifier measured.

    `value` is 0 (bad) to 1 (good), None where it could not be measured; `note` is a sentence for people. `blame` is the
    stage to ask again ("dreamer", "thinker" or "spotter") when the value is low, "" if it points at none.
    """

    name: str
    value: float | None
    note: str
    blame: str = ""


@dataclass(frozen=True)
class Usage:
    """What an answer took. `cost` is in US dollars, None where no price is known."""

    seconds: float = 0.0
    attempts: int = 1
    cached: bool = False
    tokens_in: int = 0
    tokens_out: int = 0
    cost: float | None = None
    request_id: str = ""


def finite_or_none(value: float | None) -> float | None:
    """The number itself; None for NaN and infinity, which JSON cannot hold."""
    return value if value is not None and math.isfinite(value) else None


def rounded(pixels: np.ndarray) -> Any:
    """Coordinates as JSON, to a hundredth of a pixel."""
    return np.round(pixels.astype(np.float64), 2).tolist()


def no_boxes() -> np.ndarray:
    """(0, 4) float32."""
    return np.zeros((0, 4), np.float32)


def no_points() -> np.ndarray:
    """(0, 2) float32."""
    return np.zeros((0, 2), np.float32)


@dataclass(frozen=True, eq=False)
class Detection:
    """`boxes_xyxy` (n, 4) float32, `points_xy` (m, 2) float32, `scores` (n,) float32 or None.

    As the model gave them: not clipped, not ordered, not paired. `points_derived` is true when the points were
    computed from the boxes: they tell a segmenter nothing new, and the centre of a ring is a hole.
    `masks` (n, H, W) bool only from models that segment as they detect. `cut_off` is true when the model reached its
    token limit, so that this is only a part of its answer.
    """

    boxes_xyxy: np.ndarray = field(default_factory=no_boxes)
    points_xy: np.ndarray = field(default_factory=no_points)
    scores: np.ndarray | None = None
    points_derived: bool = False
    masks: np.ndarray | None = None
    text: str = ""
    cut_off: bool = False
    usage: Usage = field(default_factory=Usage)


@dataclass(frozen=True, eq=False)
class Region:
    """Where: one part. `box_xyxy` (4,) float32 or None, `points_xy` (k, 2) float32, `mask` (H, W) bool.

    `score` is the detector's, or the segmenter's where the detector has none. `predicted_iou` is what the segmenter
    expects its mask to reach, None without a segmenter.
    """

    box_xyxy: np.ndarray | None
    points_xy: np.ndarray
    mask: np.ndarray
    score: float | None = None
    predicted_iou: float | None = None

    @property
    def tight_box_xyxy(self) -> np.ndarray | None:
        """The box (4,) float32 around the mask's pixels, None for a blank mask."""
        return tight_box(self.mask)

    @property
    def any_box_xyxy(self) -> np.ndarray | None:
        """The box (4,) float32: its own, else the tight one around the mask; None for a blank mask without a box."""
        return self.tight_box_xyxy if self.box_xyxy is None else self.box_xyxy


@dataclass(frozen=True, eq=False)
class Query:
    """A question to the agent: all that a stage may know of a sample. `id` is unique within a run."""

    id: str
    image: str | Path | bytes | np.ndarray | Image = field(repr=False)
    instruction: str


@dataclass(frozen=True, eq=False)
class Given:
    """Answers known beforehand; the stages that would find them do not run.

    For people who know the part they want, and for oracle runs that ask what a stage costs.
    `regions` are final.
    """

    imagination: Imagination | None = None
    target: Target | None = None
    detection: Detection | None = None
    regions: tuple[Region, ...] | None = None


@dataclass(frozen=True)
class Step:
    """One model call: who was asked what by which stage, what it answered and what it took.

    `seconds` is wall time including retries; `cost` is in US dollars, None where no price is known. `cut_off` marks an
    answer that ended at the token limit, `error` one that failed or could not be used.
    """

    stage: str
    role: str
    expert: str
    seconds: float = 0.0
    cached: bool = False
    attempts: int = 1
    tokens_in: int = 0
    tokens_out: int = 0
    cost: float | None = None
    prompt_hash: str = ""
    prompt: str = ""
    answer: str = ""
    request_id: str = ""
    cut_off: bool = False
    error: str = ""


@dataclass(frozen=True)
class Trace:
    """All model calls behind one answer, in order."""

    steps: tuple[Step, ...] = ()

    @property
    def seconds(self) -> float:
        return sum(step.seconds for step in self.steps)

    @property
    def cost(self) -> float:
        """Dollars known to have been spent on calls that were not answered from the cache."""
        return sum(step.cost or 0.0 for step in self.steps if not step.cached)


@dataclass(frozen=True, eq=False)
class Affordance:
    """The answer for one image and one instruction.

    `size_wh` is (width, height) of the image in pixels; `image` is that picture, upright and RGB, kept
    for drawing (None when the value was read back from a file); `id` is the query's, where there was one.
    `confidence` is the probability (0 to 1) that the mask is right, by the Verifier's `checks`; None without one.
    `image_path`, `profile` and `version` (of this package) say where the answer came from, where that is known.
    """

    instruction: str
    size_wh: tuple[int, int]
    imagination: Imagination | None = None
    target: Target | None = None
    regions: tuple[Region, ...] = ()
    status: Status = "ok"
    error: str | None = None
    trace: Trace = field(default_factory=Trace)
    image: Image | None = field(default=None, repr=False)
    id: str = ""
    confidence: float | None = None
    checks: tuple[Check, ...] = ()
    image_path: str | None = None
    profile: str | None = None
    version: str | None = None

    @property
    def mask(self) -> np.ndarray:
        """The union of the regions' masks, (H, W) bool."""
        width, height = self.size_wh
        union = np.zeros((height, width), dtype=bool)
        for region in self.regions:
            union |= region.mask
        return union

    @property
    def boxes_xyxy(self) -> np.ndarray:
        """The boxes of the regions that have one, (n, 4) float32."""
        boxes = [region.box_xyxy for region in self.regions if region.box_xyxy is not None]
        return np.array(boxes, np.float32).reshape(-1, 4)

    @property
    def points_xy(self) -> np.ndarray:
        """All key points, (n, 2) float32."""
        points = [region.points_xy.reshape(-1, 2) for region in self.regions]
        return np.concatenate([no_points(), *points]).astype(np.float32)

    def to_dict(self) -> dict[str, Any]:
        """Everything but the pictures, ready for `json.dumps`; masks as COCO RLE."""
        return {
            "schema": SCHEMA,
            "id": self.id,
            "instruction": self.instruction,
            "size_wh": list(self.size_wh),
            "image_path": self.image_path,
            "profile": self.profile,
            "version": self.version,
            "status": self.status,
            "error": self.error,
            "confidence": self.confidence,
            "checks": [asdict(check) for check in self.checks],
            "target": asdict(self.target) if self.target else None,
            "imagination": {"prompt": self.imagination.prompt} if self.imagination else None,
            "boxes_xyxy": rounded(self.boxes_xyxy),
            "points_xy": rounded(self.points_xy),
            "mask": encode_rle(self.mask),
            "regions": [
                {
                    "box_xyxy": None if region.box_xyxy is None else rounded(region.box_xyxy),
                    "points_xy": rounded(region.points_xy),
                    "mask": encode_rle(region.mask),
                    "score": region.score,
                    "predicted_iou": region.predicted_iou,
                }
                for region in self.regions
            ],
            "trace": [asdict(step) for step in self.trace.steps],
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Affordance:
        """The inverse of `to_dict`; pictures are None.

        Raises:
            DataError: the value was not written by `to_dict`, or by a newer version of it.
        """
        if not isinstance(cast(Any, data), Mapping):
            raise DataError(f"an affordance is a JSON object, not {type(data).__name__}")
        if data.get("schema") != SCHEMA:
            raise DataError(f"an affordance of schema {data.get('schema')!r}; this version reads {SCHEMA}")
        try:
            width, height = data["size_wh"]
            rows = data["regions"]
            if len(rows) == 1 and rows[0]["mask"] is None:  # as a server sends it
                rows = [{**rows[0], "mask": data["mask"]}]
            regions = tuple(_region(row) for row in rows)
            if any(region.mask.shape != (height, width) for region in regions):
                raise ValueError(f"a mask that is not {height} x {width}")
            imagined = data["imagination"]
            return cls(
                instruction=data["instruction"],
                size_wh=(int(width), int(height)),
                imagination=Imagination(imagined["prompt"], None) if imagined else None,
                target=Target(**data["target"]) if data["target"] else None,
                regions=regions,
                status=data["status"],
                error=data["error"],
                trace=Trace(tuple(Step(**step) for step in data["trace"])),
                id=data.get("id", ""),
                confidence=data["confidence"],
                checks=tuple(Check(**check) for check in data["checks"]),
                image_path=data.get("image_path"),
                profile=data.get("profile"),
                version=data.get("version"),
            )
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise DataError(f"not an affordance as this package writes it: {error!r}") from error

    @property
    def phrase(self) -> str:
        """The part as the Thinker named it, or the instruction when no Thinker ran."""
        return self.target.object_part if self.target else self.instruction

    @property
    def summary(self) -> str:
        """One line for people: the part, or why there is none."""
        if self.status == "ok":
            return self.phrase
        if self.status == "abstained":
            unsure = "unsure" if self.confidence is None else f"unsure ({self.confidence:.2f})"
            return f"{unsure}: {self.phrase}"
        if self.status == "empty":
            return f"not found: {self.phrase}"
        return f"{self.status}: {self.reason or self.phrase}"

    @property
    def reason(self) -> str:
        """`error` as a sentence, without the name of its class; "" if there is none."""
        return re.sub(r"^[A-Z]\w+: ", "", self.error or "")

    def draw(self, *, caption: bool = True, opacity: float = 0.5) -> Image:
        """The photograph with the answer over it, 640 to 1600 pixels on its longer side; hatched if it abstained.

        Raises:
            InputError: the answer was read from a file and has no photograph.
        """
        if self.image is None:
            raise InputError("this answer was read from a file and has no photograph; see imaging.overlay.draw")
        return overlay.draw(
            self.image,
            self.regions,
            caption=self.summary if caption else None,
            opacity=opacity,
            hatched=self.status == "abstained",
        )

    def save(self, folder: str | Path) -> Path:
        """Write affordance.json, mask.png, overlay.png and imagination.png (the last two if there is a picture).

        Returns the folder.

        Raises:
            InputError: the folder is not writable.
        """
        pictures: dict[str, Image] = {}
        if self.size_wh[0] and self.size_wh[1]:
            pictures["mask.png"] = Pillow.fromarray(self.mask.astype(np.uint8) * 255)
        if self.image is not None:
            pictures["overlay.png"] = self.draw()
        if self.imagination is not None and self.imagination.image is not None:
            pictures["imagination.png"] = self.imagination.image.convert("RGB")
        return write_answer(Path(folder), self.to_dict(), pictures)

    @classmethod
    def load(cls, folder: str | Path) -> Affordance:
        """Read an answer that `save` wrote; its pictures stay on disk.

        Raises:
            InputError: there is no such file.
            DataError: it is not an affordance.
        """
        path = Path(folder) / "affordance.json"
        try:
            return cls.from_dict(json.loads(path.read_text(encoding="utf-8")))
        except OSError as error:
            raise InputError(f"cannot read {str(path)!r}: {error}") from error
        except (ValueError, RecursionError, DataError) as error:
            raise DataError(f"{str(path)!r} is not a saved answer: {error}") from error


def _region(row: Mapping[str, Any]) -> Region:
    box = cast("list[float] | None", row["box_xyxy"])
    return Region(
        box_xyxy=None if box is None else np.array(box, np.float32),
        points_xy=np.array(row["points_xy"], np.float32).reshape(-1, 2),
        mask=decode_rle(row["mask"]),
        score=row["score"],
        predicted_iou=row["predicted_iou"],
    )
