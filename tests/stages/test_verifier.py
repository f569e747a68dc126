"""The Verifier: from checks to a confidence, and signals that fail."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from PIL import Image

from a4agent.config import VerifierSettings
from a4agent.errors import BudgetExceeded, ConfigError, CredentialError, ProviderUnavailable
from a4agent.stages.calibration import Calibration
from a4agent.stages.review import Review
from a4agent.stages.signals import MaskGeometry, Mirror
from a4agent.stages.spotter import Spotter
from a4agent.stages.verifier import Verdict, Verifier
from a4agent.testing import ScriptedDetector, ScriptedSegmenter
from a4agent.types import Affordance, Check, Region

SPOTTER = Spotter(ScriptedDetector(), ScriptedSegmenter())
ANSWER = Affordance(
    "x",
    (64, 48),
    regions=(Region(None, np.zeros((0, 2), np.float32), np.ones((48, 64), bool)),),
    image=Image.new("RGB", (64, 48)),
)


class Fixed:
    """A signal that measures what it is told, or fails as it is told."""

    needs = ()

    def __init__(self, name: str, value: Any, blame: str = "spotter") -> None:
        self.name, self._value, self._blame = name, value, blame

    def measure(self, evidence: Any) -> list[Check]:
        if isinstance(self._value, Exception):
            raise self._value
        return [Check(self.name, self._value, f"it is {self._value}", self._blame)]


def test_without_a_calibration_the_weakest_check_counts() -> None:
    verdict = Verifier((Fixed("a", 0.8), Fixed("b", 0.3, "thinker"), Fixed("c", None))).check(ANSWER, SPOTTER)
    assert verdict.confidence == 0.3
    assert verdict.worst == Check("b", 0.3, "it is 0.3", "thinker")
    assert [check.name for check in verdict.checks] == ["a", "b", "c"]


def test_a_calibration_turns_the_checks_into_a_probability() -> None:
    calibration = Calibration("isotonic", ("a",), (1.0,), (0.5,), knots=((0.0, 0.0), (1.0, 0.5)))
    assert Verifier((Fixed("a", 0.8),), calibration=calibration).check(ANSWER, SPOTTER).confidence == pytest.approx(0.4)
    missing = Verifier((Fixed("a", ProviderUnavailable("down")),), calibration=calibration).check(ANSWER, SPOTTER)
    assert missing.confidence == pytest.approx(0.25)


def test_a_signal_that_fails_is_a_check_without_a_value() -> None:
    verdict = Verifier((Fixed("a", ProviderUnavailable("the server is down")),)).check(ANSWER, SPOTTER)
    assert verdict.confidence is None
    assert verdict.worst is None
    (check,) = verdict.checks
    assert (check.name, check.value) == ("a", None)
    assert "the server is down" in check.note


@pytest.mark.parametrize("error", [CredentialError("no key"), BudgetExceeded("spent")])
def test_what_every_sample_would_meet_is_raised(error: Exception) -> None:
    with pytest.raises(type(error)):
        Verifier((Fixed("a", error),)).check(ANSWER, SPOTTER)


@pytest.mark.parametrize(("confidence", "accepted"), [(0.5, True), (0.4999, False), (1.0, True), (None, False)])
def test_accept_is_the_least_confidence_taken(confidence: float | None, accepted: bool) -> None:
    assert Verifier((), accept=0.5).accepts(confidence) is accepted


def test_a_signal_without_its_expert_names_the_setting() -> None:
    with pytest.raises(ConfigError, match=r"'review'.*verifier\.vlm"):
        Verifier((MaskGeometry(), Review()))


def test_only_checks_that_blame_a_stage_are_worst() -> None:
    checks = Check("a", 0.0, "x"), Check("b", 0.6, "x", "spotter"), Check("c", None, "x", "spotter")
    assert Verdict(0.5, checks).worst == checks[1]
    assert Verdict(0.5, checks[:1]).worst is None


def test_a_mirror_costs_one_more_look() -> None:
    detector = ScriptedDetector()
    Verifier((Mirror(),)).check(ANSWER, Spotter(detector, ScriptedSegmenter()))
    assert len(detector.requests) == 1


def test_the_defaults_are_those_of_the_settings() -> None:
    settings, verifier = VerifierSettings(), Verifier(())
    for name in ("accept", "retries", "prompts", "max_tokens"):
        assert getattr(settings, name) == getattr(verifier, name)
    assert settings.signals == ["geometry"]
