"""The agent: an image and an instruction go in, the part to act on comes out. The paper on one screen.

dreamer.imagine  ->  thinker.decide  ->  spotter.locate
     how                 what               where
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

from a4agent import engine
from a4agent.errors import A4Error, AnswerError, BudgetExceeded, InputError
from a4agent.imaging.load import MAX_PIXELS, load_image
from a4agent.protocols import Expert, Segmenter
from a4agent.stages.dreamer import Dreamer
from a4agent.stages.recorder import Recorder
from a4agent.stages.spotter import Spotter
from a4agent.stages.thinker import Thinker
from a4agent.types import Affordance, Given, Query, Status

if TYPE_CHECKING:
    from PIL.Image import Image

    from a4agent.config import Settings

StageName = Literal["imagination", "target", "detection", "affordance"]
OnStage = Callable[[StageName, Any], None]


@dataclass(frozen=True)
class A4Agent:
    """The three stages. No Dreamer: the Thinker sees one image. No Thinker: the instruction is the phrase."""

    dreamer: Dreamer | None
    thinker: Thinker | None
    spotter: Spotter
    max_pixels: int = MAX_PIXELS

    @classmethod
    def from_profile(cls, profile: str | Path = "offline", overrides: Mapping[str, Any] | None = None) -> A4Agent:
        """The agent of a profile's name or TOML file, with settings replaced by dotted name.

        Raises:
            ConfigError: unknown profile, setting or expert; the message suggests the nearest.
        """
        from a4agent.config import load_settings

        return cls.from_settings(load_settings(profile, overrides))

    @classmethod
    def from_settings(cls, settings: Settings, experts: Mapping[str, Expert] | None = None) -> A4Agent:
        """The agent of merged settings. `experts` maps each role ("thinker.vlm") to a ready expert; None builds them.

        Raises:
            ConfigError: unknown expert or setting; the message suggests the nearest.
        """
        from a4agent.experts import registry

        built: dict[str, Any] = dict(registry.build(settings.expert_specs()) if experts is None else experts)
        d, t, s = settings.dreamer, settings.thinker, settings.spotter
        dreamer = d and Dreamer(built["dreamer.vlm"], built["dreamer.editor"], d.prompts, d.seed, d.max_tokens)
        thinker = t and Thinker(built["thinker.vlm"], t.prompts, t.max_tokens, t.reasks, t.structured)
        spotter = Spotter(built["spotter.detector"], built.get("spotter.segmenter"), s.pairing)
        return cls(dreamer, thinker, spotter, settings.image.max_pixels)

    def predict(
        self,
        image: str | Path | bytes | np.ndarray | Image,
        instruction: str,
        *,
        given: Given | None = None,
        on_stage: OnStage | None = None,
        on_step: Callable[[int, int], None] | None = None,
    ) -> Affordance:
        """Where to act for `instruction` in `image` (a path, bytes, PIL image or uint8 RGB array).

        What a model does wrong is a status and an error text of the answer. `on_stage` hears each result as
        it comes; `on_step` the editor's progress (done, total). Answers in `given` are not asked for again.

        Raises:
            InputError: the image cannot be read or the instruction is blank.
            UserError: a key, model or setting is missing, so that no sample could succeed.
        """
        picture = load_image(image, max_pixels=self.max_pixels)
        instruction = _checked(instruction)
        given, tell = given or Given(), on_stage or _nobody
        recorder = Recorder()
        answer = Affordance(instruction, picture.size, image=picture)
        try:
            found_already = given.detection is not None or given.regions is not None
            imagination = given.imagination
            if imagination is None and self.dreamer and given.target is None and not found_already:
                imagination = self.dreamer.imagine(picture, instruction, recorder, on_step)
            if imagination is not None:
                answer = replace(answer, imagination=imagination)
                tell("imagination", imagination)
            target = given.target
            if target is None and self.thinker and not found_already:
                target = self.thinker.decide(picture, instruction, imagination, recorder)
            if target is not None:
                answer = replace(answer, target=target)
                tell("target", target)
            regions = given.regions
            if regions is None:
                phrase = target.object_part if target else instruction
                regions = self.spotter.locate(
                    picture, phrase, recorder, given.detection, lambda found: tell("detection", found)
                )
            found = any(region.mask.any() for region in regions)
            answer = replace(answer, regions=regions, status="ok" if found else "empty")
        except A4Error as error:
            if error.fatal or isinstance(error, BudgetExceeded):
                raise
            status: Status = "invalid" if isinstance(error, AnswerError) else "error"
            answer = replace(answer, status=status, error=f"{type(error).__name__}: {error}")
        answer = replace(answer, trace=recorder.trace)
        tell("affordance", answer)
        return answer

    def predict_many(
        self, samples: Iterable[Query | tuple[Any, str]], *, ordered: bool = False, **settings: Any
    ) -> Iterator[Affordance]:
        """Predict many (image, instruction) pairs or queries at once, through the engine.

        A sample that fails, whatever the reason, is an Affordance of status "error". They come as they finish,
        each with the `id` of its query (the pair's number), or in the samples' order with `ordered`. `settings`
        are fields of `engine.EngineSettings`.
        """
        queries = (
            sample if isinstance(sample, Query) else Query(str(number), sample[0], sample[1])
            for number, sample in enumerate(samples)
        )
        for _, affordance in engine.run(self, queries, settings=engine.EngineSettings(**settings), ordered=ordered):
            yield affordance

    @property
    def segmenter(self) -> Segmenter | None:
        return self.spotter.segmenter

    def experts(self) -> list[Expert]:
        """The agent's models, each once."""
        held = [
            self.dreamer and self.dreamer.vlm,
            self.dreamer and self.dreamer.editor,
            self.thinker and self.thinker.vlm,
            self.spotter.detector,
            self.spotter.segmenter,
        ]
        return list({id(expert): expert for expert in held if expert is not None}.values())

    def with_experts(self, wrap: Callable[[Any], Any]) -> A4Agent:
        """The same agent with every expert replaced by `wrap(expert)`; one that is shared stays shared."""
        wrapped = {id(expert): wrap(expert) for expert in self.experts()}

        def of(expert: Any) -> Any:
            return None if expert is None else wrapped[id(expert)]

        dreamer = self.dreamer and replace(self.dreamer, vlm=of(self.dreamer.vlm), editor=of(self.dreamer.editor))
        thinker = self.thinker and replace(self.thinker, vlm=of(self.thinker.vlm))
        spotter = replace(self.spotter, detector=of(self.spotter.detector), segmenter=of(self.spotter.segmenter))
        return replace(self, dreamer=dreamer, thinker=thinker, spotter=spotter)

    def close(self) -> None:
        """Let go of all models."""
        for expert in self.experts():
            expert.close()

    def __enter__(self) -> A4Agent:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _checked(instruction: str) -> str:
    text = cast(Any, instruction)
    if not isinstance(text, str):
        raise InputError(f"the instruction is text, not {type(text).__name__}")
    if not text.strip():
        raise InputError("the instruction is blank; say what to do, for instance 'open the refrigerator'")
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise InputError(f"the instruction {text!r} is not Unicode text: {error.reason}; write it in UTF-8") from error
    return text.strip()


def _nobody(name: StageName, value: Any) -> None:
    return None
