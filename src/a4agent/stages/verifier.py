"""Whether: the Verifier estimates how likely an answer is to be right, without knowing the truth.

    verifier.check(affordance, spotter, recorder)
    -> Verdict(confidence=0.34, checks=(Check("mirror", 0.12, "in the mirrored picture ...", blame="spotter"), ...))

Signals measure (see `stages.signals`), a calibration turns their values into a probability. Without a calibration
the confidence is the weakest check: a ranking, not a probability; it is None if a signal failed, which may have been
the weakest. `A4Agent` asks the blamed stage again, at most `retries` times.
"""

from __future__ import annotations

from dataclasses import dataclass

from a4agent.errors import A4Error, BudgetExceeded, ConfigError
from a4agent.protocols import Detector, Segmenter, VisionLanguageModel
from a4agent.stages.calibration import Calibration, values_of
from a4agent.stages.recorder import Recorder
from a4agent.stages.signals import Evidence, Signal
from a4agent.stages.spotter import Spotter
from a4agent.types import Affordance, Check


@dataclass(frozen=True)
class Verdict:
    """`confidence` (0 to 1, None if nothing could be measured) and the checks behind it."""

    confidence: float | None
    checks: tuple[Check, ...] = ()

    @property
    def worst(self) -> Check | None:
        """The check with the lowest value among those that blame a stage: that stage is to be asked again."""
        blaming = [check for check in self.checks if check.blame and check.value is not None]
        return min(blaming, key=lambda check: check.value or 0.0, default=None)


@dataclass(frozen=True)
class Verifier:
    """Measures signals and decides whether an answer is accepted. `retries` is for the agent, which asks again."""

    signals: tuple[Signal, ...]
    accept: float = 0.5
    retries: int = 2
    calibration: Calibration | None = None
    vlm: VisionLanguageModel | None = None
    detector: Detector | None = None
    segmenter: Segmenter | None = None
    prompts: str = "verifier"
    max_tokens: int = 1024

    def __post_init__(self) -> None:
        for signal in self.signals:
            for need in signal.needs:
                if getattr(self, need) is None:
                    raise ConfigError(
                        f"the signal {signal.name!r} asks an expert; set verifier.{need} or remove it from"
                        " verifier.signals"
                    )

    def check(self, affordance: Affordance, spotter: Spotter, recorder: Recorder | None = None) -> Verdict:
        """Measure an answer, which carries its picture.

        A signal that fails for this sample alone is a check without a value.

        Raises:
            A4Error: a failure that every other sample would meet (`error.fatal`).
            BudgetExceeded: the run may not ask any more.
        """
        evidence = Evidence(
            affordance,
            spotter,
            recorder or Recorder(),
            self.vlm,
            self.detector,
            self.segmenter,
            self.prompts,
            self.max_tokens,
        )
        checks: list[Check] = []
        failed = False
        for signal in self.signals:
            try:
                checks += signal.measure(evidence)
            except A4Error as error:
                if error.fatal or isinstance(error, BudgetExceeded):
                    raise
                failed = True
                checks.append(Check(signal.name, None, f"not measured: {error}"))
        if self.calibration is not None:
            confidence: float | None = self.calibration.probability(values_of(checks))
        else:
            known = [check.value for check in checks if check.value is not None]
            confidence = min(known) if known and not failed else None
        return Verdict(confidence, tuple(checks))

    def accepts(self, confidence: float | None) -> bool:
        """Whether an answer of this confidence is `ok`; otherwise the agent abstains."""
        return confidence is not None and confidence >= self.accept
