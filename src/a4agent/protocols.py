"""The four batched protocols that stages talk to models through, with their requests and answers.

    vlm.chat([ChatRequest(images=(photo,), text="Given the image ...")])      -> [ChatAnswer(text="### Thinking ...")]
    editor.edit([EditRequest(image=photo, prompt="Edit the input image ...")]) -> [EditAnswer(image=...)]
    detector.detect([DetectRequest(image=photo, phrase="the handle of the mug")])
                                                        -> [Detection(boxes_xyxy=[[402, 180, 471, 322]], ...)]
    segmenter.segment([SegmentRequest(image=photo, prompts=(Prompt(box_xyxy=..., points_xy=...),))])
                                                        -> [Segmentation(masks=(1, 3, H, W), predicted_iou=(1, 3))]

Every method takes a sequence and returns a list of the same length and order. An element of the
answer may be an `A4Error` *instance*, which concerns that request alone; a *raised* error concerns the
whole batch. Experts are synchronous and must be safe for `concurrency` calls at once. Images are
RGB `PIL.Image`s; coordinates are pixels of the request's image (see `experts.coordinates`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, Protocol, TypeVar, runtime_checkable

import numpy as np
from PIL.Image import Image

from a4agent.errors import A4Error
from a4agent.types import Affordance, Detection, Given, Trace, Usage, no_points

Role = Literal["vlm", "editor", "detector", "segmenter"]
VERBS: dict[Role, str] = {"vlm": "chat", "editor": "edit", "detector": "detect", "segmenter": "segment"}


@dataclass(frozen=True, eq=False)
class ChatRequest:
    """Images, then text. `schema` is a JSON schema that the text of the answer should follow, if the model can.

    `attempt` counts the re-asks of one question from 0, so that a cache does not repeat a bad answer.
    """

    verb: ClassVar[str] = "chat"
    role: ClassVar[Role] = "vlm"
    images: tuple[Image, ...]
    text: str
    system: str | None = None
    schema: Mapping[str, Any] | None = None
    max_tokens: int = 2048
    attempt: int = 0


@dataclass(frozen=True, eq=False)
class ChatAnswer:
    """`reasoning` is what the server returned besides the text; `finish_reason` is "stop" or "length"."""

    text: str
    reasoning: str = ""
    finish_reason: str = "stop"
    usage: Usage = field(default_factory=Usage)


@dataclass(frozen=True, eq=False)
class EditRequest:
    """Edit `image` as `prompt` says. `on_step(done, total)` may be called while the editor works."""

    verb: ClassVar[str] = "edit"
    role: ClassVar[Role] = "editor"
    image: Image
    prompt: str
    seed: int = 0
    on_step: Callable[[int, int], None] | None = field(default=None, repr=False)


@dataclass(frozen=True, eq=False)
class EditAnswer:
    """The edited picture, in whatever size the editor gave it."""

    image: Image
    usage: Usage = field(default_factory=Usage)


@dataclass(frozen=True, eq=False)
class DetectRequest:
    """Find `phrase` ("the handle of the mug") in `image`."""

    verb: ClassVar[str] = "detect"
    role: ClassVar[Role] = "detector"
    image: Image
    phrase: str


@dataclass(frozen=True, eq=False)
class Prompt:
    """One region to segment: `box_xyxy` (4,) or None, and `points_xy` (k, 2) in it; at least one of them."""

    box_xyxy: np.ndarray | None = None
    points_xy: np.ndarray = field(default_factory=no_points)


@dataclass(frozen=True, eq=False)
class SegmentRequest:
    """All regions of one image, in one request. Prompts lie inside the image."""

    verb: ClassVar[str] = "segment"
    role: ClassVar[Role] = "segmenter"
    image: Image
    prompts: tuple[Prompt, ...]


@dataclass(frozen=True, eq=False)
class Segmentation:
    """`masks` (p, c, H, W) bool: c candidates per prompt at the image's size; `predicted_iou` (p, c) float32.

    An adapter that keeps only its best candidate returns c = 1.
    """

    masks: np.ndarray
    predicted_iou: np.ndarray
    usage: Usage = field(default_factory=Usage)


Request = ChatRequest | EditRequest | DetectRequest | SegmentRequest
Answer = ChatAnswer | EditAnswer | Detection | Segmentation
AnswerT = TypeVar("AnswerT", ChatAnswer, EditAnswer, Detection, Segmentation)


@runtime_checkable
class Expert(Protocol):
    """What all experts have in common."""

    @property
    def id(self) -> str:
        """ "provider:model"."""
        ...

    @property
    def max_batch(self) -> int:
        """The most requests one call may carry."""
        ...

    @property
    def concurrency(self) -> int:
        """The most calls in flight at once."""
        ...

    def fingerprint(self) -> Mapping[str, Any]:
        """Everything but the request that changes an answer: id, revision, settings. JSON-safe; cache keys hold it."""
        ...

    def close(self) -> None:
        """Release memory, connections and threads. Safe to call twice."""
        ...


class VisionLanguageModel(Expert, Protocol):
    """Reads images and text, writes text."""

    def chat(self, requests: Sequence[ChatRequest]) -> list[ChatAnswer | A4Error]: ...


class ImageEditor(Expert, Protocol):
    """Redraws a picture as a prompt says."""

    def edit(self, requests: Sequence[EditRequest]) -> list[EditAnswer | A4Error]: ...


class Detector(Expert, Protocol):
    """Finds what a phrase names: boxes, key points, or both."""

    def detect(self, requests: Sequence[DetectRequest]) -> list[Detection | A4Error]: ...


class Segmenter(Expert, Protocol):
    """Turns boxes and points into masks."""

    def segment(self, requests: Sequence[SegmentRequest]) -> list[Segmentation | A4Error]: ...


@dataclass(frozen=True, eq=False)
class Tracked:
    """`mask` (H, W) bool in this frame; `quality` from 0 (lost) to 1."""

    mask: np.ndarray
    quality: float


class Tracker(Protocol):
    """Follows one mask through consecutive frames of one size."""

    def start(self, frame: Image, mask: np.ndarray) -> None:
        """Follow `mask` (H, W) bool from here on; what was followed before is dropped."""
        ...

    def step(self, frame: Image) -> Tracked:
        """Where the mask is in the next frame."""
        ...

    def close(self) -> None:
        """Release memory."""
        ...


@runtime_checkable
class Prepares(Protocol):
    """A segmenter that can do the part of its work that needs no prompts (the image encoding) ahead of time."""

    def prepare(self, images: Sequence[Image]) -> None: ...


@runtime_checkable
class Charges(Protocol):
    """An expert whose answers cost money; `price_known` says whether they carry their cost."""

    @property
    def price_known(self) -> bool: ...


@runtime_checkable
class Repeats(Protocol):
    """An expert that repeats failed calls by itself, with waits that cannot be interrupted."""

    def without_retries(self) -> Expert:
        """The same expert, making each call once; usable until the original is closed."""
        ...


class Agent(Protocol):
    """What the engine needs of an agent; `a4agent.agent.A4Agent` is the one that ships."""

    @property
    def segmenter(self) -> Segmenter | None: ...

    def experts(self) -> list[Expert]:
        """The agent's models, each once."""
        ...

    def with_experts(self, wrap: Callable[[Any], Any]) -> Agent:
        """The same agent with every expert replaced by `wrap(expert)`."""
        ...

    def predict(
        self,
        image: Any,
        instruction: str,
        *,
        given: Given | None = None,
        may_retry: Callable[[Trace], bool] | None = None,
    ) -> Affordance:
        """The answer for one image and one instruction; see `a4agent.agent.A4Agent.predict`."""
        ...


class ExpertBase:
    """The bookkeeping that most experts share; optional, since stages use the protocol only."""

    def __init__(
        self,
        id: str,
        *,
        revision: str = "",
        settings: Mapping[str, Any] | None = None,
        max_batch: int = 1,
        concurrency: int = 1,
    ) -> None:
        self.id = id
        self.revision = revision
        self.settings: dict[str, Any] = dict(settings or {})
        self.max_batch = max_batch
        self.concurrency = concurrency

    def fingerprint(self) -> Mapping[str, Any]:
        return {"id": self.id, "revision": self.revision, "settings": self.settings}

    def close(self) -> None:
        return None

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.id!r})"


def ask(expert: Expert, requests: Sequence[Request]) -> list[Answer | A4Error]:
    """Call the method of `expert` that these requests (all of one kind) belong to."""
    return getattr(expert, requests[0].verb)(requests) if requests else []


def with_usage(answer: AnswerT, **changes: Any) -> AnswerT:
    """The same answer with some fields of its `usage` replaced."""
    return replace(answer, usage=replace(answer.usage, **changes))
