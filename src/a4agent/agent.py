"""The agent: an image and an instruction go in, the part to act on comes out. The paper on one screen.

dreamer.imagine  ->  thinker.decide  ->  spotter.locate  ->  verifier.check
     how                 what               where               whether
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from PIL.Image import Image

from a4agent import __version__, engine
from a4agent.config import STAGES, Settings, load_settings
from a4agent.errors import A4Error, AnswerError, BudgetExceeded, InputError, ProviderError
from a4agent.experts import registry
from a4agent.imaging.load import MAX_PIXELS, load_image
from a4agent.protocols import VERBS, Expert, Segmenter
from a4agent.stages.calibration import load_calibration
from a4agent.stages.dreamer import Dreamer
from a4agent.stages.recorder import Recorder
from a4agent.stages.signals import locate_differently, signals
from a4agent.stages.spotter import Spotter
from a4agent.stages.thinker import Thinker
from a4agent.stages.verifier import Verdict, Verifier
from a4agent.types import Affordance, Given, Query, Region, Status, Trace

StageName = Literal["imagination", "target", "detection", "affordance"]
OnStage = Callable[[StageName, Any], None]

MAX_INSTRUCTION = 20_000
"""Characters of an instruction."""


@dataclass(frozen=True)
class A4Agent:
    """The stages. No Dreamer: the Thinker sees one image. No Thinker: the instruction is the phrase.

    No Verifier: every mask is accepted, and `confidence` is None.
    """

    dreamer: Dreamer | None
    thinker: Thinker | None
    spotter: Spotter
    max_pixels: int = MAX_PIXELS
    verifier: Verifier | None = None
    profile: str | None = None

    @classmethod
    def from_profile(cls, profile: str | Path = "offline", overrides: Mapping[str, Any] | None = None) -> A4Agent:
        """The agent of a profile's name or TOML file, with settings replaced by dotted name.

        Raises:
            ConfigError: unknown profile, setting or expert; the message suggests the nearest.
        """
        return cls.from_settings(load_settings(profile, overrides))

    @classmethod
    def from_settings(cls, settings: Settings, experts: Mapping[str, Expert] | None = None) -> A4Agent:
        """The agent of merged settings. `experts` maps each role ("thinker.vlm") to a ready expert; None builds them.

        Raises:
            ConfigError: unknown expert or setting; the message suggests the nearest.
        """
        built: dict[str, Any] = dict(registry.build(settings.expert_specs()) if experts is None else experts)
        d, t, s, v = settings.dreamer, settings.thinker, settings.spotter, settings.verifier
        dreamer = d and Dreamer(
            built["dreamer.vlm"], built["dreamer.editor"], d.prompts, d.seed, d.max_tokens, d.required
        )
        thinker = t and Thinker(built["thinker.vlm"], t.prompts, t.max_tokens, t.reasks, t.structured)
        spotter = Spotter(built["spotter.detector"], built.get("spotter.segmenter"), s.pairing)
        verifier = v and Verifier(
            tuple(signals.find(name)() for name in v.signals),
            v.accept,
            v.retries,
            load_calibration(v.calibration) if v.calibration else None,
            built.get("verifier.vlm") or built.get("thinker.vlm"),
            built.get("verifier.detector"),
            built.get("verifier.segmenter"),
            v.prompts,
            v.max_tokens,
        )
        return cls(dreamer, thinker, spotter, settings.image.max_pixels, verifier, settings.name)

    def predict(
        self,
        image: str | Path | bytes | np.ndarray | Image,
        instruction: str,
        *,
        given: Given | None = None,
        on_stage: OnStage | None = None,
        on_step: Callable[[int, int], None] | None = None,
        may_retry: Callable[[Trace], bool] | None = None,
    ) -> Affordance:
        """Where to act for `instruction` in `image` (a path, bytes, PIL image or uint8 RGB array).

        Model failures are returned in `status` and `error`. `on_stage` receives each stage's result as it comes,
        `on_step` the editor's progress (done, total). Answers in `given` are not asked for again. `may_retry` is asked
        with the trace so far before a stage is asked again because the Verifier rejected the answer.

        Raises:
            InputError: the image cannot be read, or the instruction is blank or longer than MAX_INSTRUCTION.
            UserError: a key, model or setting is missing, so that no sample could succeed.
        """
        picture = load_image(image, max_pixels=self.max_pixels)
        answer = Affordance(
            _checked(instruction),
            picture.size,
            image=picture,
            image_path=str(image) if isinstance(image, (str, Path)) else None,
            profile=self.profile,
            version=__version__,
        )
        asked = _Question(given or Given(), Recorder(), on_stage or _ignore, on_step, may_retry or (lambda _: True))
        try:
            answer = self._imagined(answer, asked)
            answer = self._decided(answer, asked)
            answer = self._located(answer, asked)
            answer = self._verified(answer, asked)
        except A4Error as error:
            if error.fatal or isinstance(error, BudgetExceeded):
                raise
            status: Status = "invalid" if isinstance(error, AnswerError) else "error"
            answer = replace(answer, status=status, error=f"{type(error).__name__}: {error}")
        answer = replace(answer, trace=asked.recorder.trace)
        asked.tell("affordance", answer)
        return answer

    def _imagined(self, answer: Affordance, asked: _Question, retry: int = 0) -> Affordance:
        """The answer with its imagination, if a Dreamer is to be asked and gives one."""
        given = asked.given
        found_already = given.target is not None or given.detection is not None or given.regions is not None
        imagination = given.imagination
        if imagination is None and self.dreamer and not found_already:
            assert answer.image is not None
            try:
                imagination = self.dreamer.imagine(
                    answer.image, answer.instruction, asked.recorder, asked.on_step, retry
                )
            except (AnswerError, ProviderError) as error:
                asked.recorder.mark(error)
                if error.fatal or self.dreamer.required:
                    raise
        if imagination is None:
            return answer
        asked.tell("imagination", imagination)
        return replace(answer, imagination=imagination)

    def _decided(self, answer: Affordance, asked: _Question, rejected: tuple[str, str] | None = None) -> Affordance:
        """The answer with its target, if a Thinker is to be asked."""
        given = asked.given
        target = given.target
        if target is None and self.thinker and given.detection is None and given.regions is None:
            assert answer.image is not None
            target = self.thinker.decide(answer.image, answer.instruction, answer.imagination, asked.recorder, rejected)
        if target is None:
            return answer
        asked.tell("target", target)
        return replace(answer, target=target)

    def _located(self, answer: Affordance, asked: _Question) -> Affordance:
        """The answer with its regions."""
        regions = asked.given.regions
        if regions is None:
            assert answer.image is not None
            regions = self.spotter.locate(
                answer.image,
                answer.phrase,
                asked.recorder,
                asked.given.detection,
                lambda found: asked.tell("detection", found),
            )
        return _with_regions(answer, regions)

    def _verified(self, answer: Affordance, asked: _Question) -> Affordance:
        """The answer with its confidence: the best of the candidates from asking blamed stages again.

        Regions that were given are final, and are not verified.
        """
        if self.verifier is None or asked.given.regions is not None:
            return answer
        best, verdict = self._judged(answer, asked)
        retries: Counter[str] = Counter()
        for _ in range(self.verifier.retries):
            if best.status == "ok":
                break
            blamed = self._to_ask_again(best, verdict, asked.given)
            if blamed is None or not asked.may_retry(asked.recorder.trace):
                break
            retries[blamed] += 1
            reason = verdict.worst.note if verdict and verdict.worst else "nothing was found"
            quiet = replace(asked, tell=_ignore)
            try:
                again = self._asked_again(blamed, best, quiet, reason, retries[blamed])
                if again is None:
                    break
                again, judged = self._judged(again, quiet)
            except A4Error as error:
                if error.fatal or isinstance(error, BudgetExceeded):
                    raise
                asked.recorder.mark(error)
                continue
            if _rank(again) > _rank(best):
                best, verdict = again, judged
        return best

    def _judged(self, answer: Affordance, asked: _Question) -> tuple[Affordance, Verdict | None]:
        """The answer with the Verifier's verdict; an empty one is not verified."""
        assert self.verifier is not None
        if answer.status != "ok":
            return answer, None
        verdict = self.verifier.check(answer, self.spotter, asked.recorder)
        status: Status = "ok" if self.verifier.accepts(verdict.confidence) else "abstained"
        return replace(answer, status=status, confidence=verdict.confidence, checks=verdict.checks), verdict

    def _to_ask_again(self, answer: Affordance, verdict: Verdict | None, given: Given) -> str | None:
        """The blamed stage, or the next one after it that runs; None if its answer is given."""
        blamed = verdict.worst.blame if verdict and verdict.worst else ("" if verdict else "spotter")
        if not blamed or given.detection is not None:
            return None
        thinks = self.thinker is not None and given.target is None
        if blamed == "dreamer" and answer.imagination is not None and given.imagination is None and thinks:
            return "dreamer"
        return "thinker" if blamed in ("dreamer", "thinker") and thinks else "spotter"

    def _asked_again(
        self, blamed: str, answer: Affordance, asked: _Question, reason: str, retry: int
    ) -> Affordance | None:
        """Another answer, by asking a stage differently and then those after it; None if there is no other way."""
        answer = replace(answer, status="ok", confidence=None, checks=())
        if blamed == "spotter":
            assert answer.image is not None
            regions = locate_differently(self.spotter, answer, asked.recorder, retry)
            return None if regions is None else _with_regions(answer, regions)
        if blamed == "dreamer":
            answer = self._imagined(answer, asked, retry)
            return self._located(self._decided(answer, asked), asked)
        rejected = answer.phrase, reason
        return self._located(self._decided(answer, asked, rejected), asked)

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
        held = (_experts_of(getattr(self, stage)) for stage in STAGES)
        return list({id(expert): expert for by_role in held for expert in by_role.values()}.values())

    def with_experts(self, wrap: Callable[[Any], Any]) -> A4Agent:
        """The same agent with every expert replaced by `wrap(expert)`; one that is shared stays shared."""
        wrapped = {id(expert): wrap(expert) for expert in self.experts()}
        stages: dict[str, Any] = {name: stage for name in STAGES if (stage := getattr(self, name)) is not None}
        changed = {
            name: replace(stage, **{role: wrapped[id(expert)] for role, expert in _experts_of(stage).items()})
            for name, stage in stages.items()
        }
        return replace(self, **changed)

    def close(self) -> None:
        """Release all models."""
        for expert in self.experts():
            expert.close()

    def __enter__(self) -> A4Agent:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@dataclass(frozen=True)
class _Question:
    """The state of one call of `predict` besides the answer."""

    given: Given
    recorder: Recorder
    tell: OnStage
    on_step: Callable[[int, int], None] | None
    may_retry: Callable[[Trace], bool]


def _experts_of(stage: object) -> dict[str, Expert]:
    """The experts of a stage (None has none) by their roles."""
    return {role: expert for role in VERBS if (expert := getattr(stage, role, None)) is not None}


def _with_regions(answer: Affordance, regions: tuple[Region, ...]) -> Affordance:
    found = any(region.mask.any() for region in regions)
    return replace(answer, regions=regions, status="ok" if found else "empty")


def _rank(answer: Affordance) -> float:
    """How good a candidate is: its confidence; below that, an answer without a confidence, then one without a mask."""
    if answer.status == "empty":
        return -2.0
    return -1.0 if answer.confidence is None else answer.confidence


def _checked(instruction: str) -> str:
    text = cast(Any, instruction)
    if not isinstance(text, str):
        raise InputError(f"the instruction is text, not {type(text).__name__}")
    if not text.strip():
        raise InputError("the instruction is blank; say what to do, for instance 'open the refrigerator'")
    if len(text) > MAX_INSTRUCTION:
        raise InputError(f"the instruction has {len(text)} characters; {MAX_INSTRUCTION} is the limit")
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise InputError(f"the instruction {text!r} is not Unicode text: {error.reason}; write it in UTF-8") from error
    return text.strip()


def _ignore(name: StageName, value: Any) -> None:
    return None
