"""The agent: the paper's flow, its ablations, and failures as values."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import a4agent
from a4agent import A4Agent, Given, Region, Target
from a4agent.errors import CredentialError, InputError, ProviderUnavailable
from a4agent.imaging.masks import iou
from a4agent.stages.dreamer import Dreamer
from a4agent.stages.signals import Evidence
from a4agent.stages.spotter import Spotter
from a4agent.stages.thinker import Thinker
from a4agent.stages.verifier import Verifier
from a4agent.testing import ScriptedDetector, ScriptedEditor, ScriptedSegmenter, ScriptedVLM, output, scripted_agent
from a4agent.types import Check, Detection

PHOTO = Image.new("RGB", (64, 48), "grey")


def test_the_three_stages_in_order() -> None:
    heard: list[str] = []
    agent = scripted_agent("the handle of the mug", dream=True)
    affordance = agent.predict(PHOTO, " drink \n", on_stage=lambda name, value: heard.append(name))
    assert heard == ["imagination", "target", "detection", "affordance"]
    assert [(step.stage, step.role) for step in affordance.trace.steps] == [
        ("dreamer", "vlm"),
        ("dreamer", "editor"),
        ("thinker", "vlm"),
        ("spotter", "detector"),
        ("spotter", "segmenter"),
    ]
    assert affordance.status == "ok"
    assert affordance.instruction == "drink"
    assert affordance.imagination is not None
    assert affordance.target is not None
    assert affordance.target.object_part == "the handle of the mug"
    assert agent.spotter.detector.requests[0].phrase == "the handle of the mug"  # type: ignore[attr-defined]
    assert affordance.size_wh == (64, 48)
    assert affordance.mask.sum() == 32 * 24


def test_without_a_dreamer_the_thinker_sees_one_image() -> None:
    agent = scripted_agent()
    agent.predict(PHOTO, "drink")
    assert len(agent.thinker.vlm.requests[0].images) == 1  # type: ignore[union-attr]


def test_the_spotter_alone_takes_the_instruction_as_the_phrase() -> None:
    detector = ScriptedDetector()
    affordance = A4Agent(None, None, Spotter(detector, ScriptedSegmenter())).predict(PHOTO, "the red knob")
    assert detector.requests[0].phrase == "the red knob"
    assert affordance.target is None
    assert affordance.status == "ok"


def test_nothing_found_is_a_result() -> None:
    affordance = A4Agent(None, None, Spotter(ScriptedDetector([[]]), ScriptedSegmenter())).predict(PHOTO, "x")
    assert affordance.status == "empty"
    assert affordance.error is None
    assert affordance.boxes_xyxy.shape == (0, 4)
    assert affordance.points_xy.shape == (0, 2)
    assert affordance.mask.shape == (48, 64)
    assert not affordance.mask.any()


def test_an_unusable_answer_is_status_invalid_and_keeps_what_came_before() -> None:
    vlm = ScriptedVLM(["Edit it.", "no", "no", "no"])
    agent = A4Agent(Dreamer(vlm, ScriptedEditor()), Thinker(vlm), Spotter(ScriptedDetector(), ScriptedSegmenter()))
    affordance = agent.predict(PHOTO, "drink")
    assert affordance.status == "invalid"
    assert "asked 3 times" in (affordance.error or "")
    assert affordance.imagination is not None
    assert len(affordance.trace.steps) == 5


@pytest.mark.parametrize("failure", [ProviderUnavailable("the server is down"), RuntimeError("the server is down")])
def test_a_failed_model_is_status_error_with_its_step(failure: Exception) -> None:
    agent = A4Agent(None, None, Spotter(ScriptedDetector([failure]), ScriptedSegmenter()))
    affordance = agent.predict(PHOTO, "drink")
    assert affordance.status == "error"
    assert "the server is down" in (affordance.error or "")
    assert "the server is down" in affordance.trace.steps[-1].error


def test_what_no_sample_could_survive_is_raised() -> None:
    agent = A4Agent(None, None, Spotter(ScriptedDetector([CredentialError("no key")]), ScriptedSegmenter()))
    with pytest.raises(CredentialError):
        agent.predict(PHOTO, "drink")


@pytest.mark.parametrize("instruction", ["", "  \n", None, 7, "caf\udce9", "open " * 5000])
def test_a_blank_broken_or_endless_instruction_is_refused(instruction: Any) -> None:
    with pytest.raises(InputError, match="instruction"):
        scripted_agent().predict(PHOTO, instruction)


@pytest.mark.parametrize("instruction", ["打开冰箱", "ouvre le réfrigérateur", "открой 🧊", 'say "open"', "TASK"])
def test_any_language_reaches_the_model_unchanged(instruction: str) -> None:
    agent = scripted_agent(dream=True)
    agent.predict(PHOTO, instruction)
    assert all(instruction in request.text for request in agent.thinker.vlm.requests)  # type: ignore[union-attr]


def test_images_as_paths_arrays_and_bytes_give_the_same_answer(tmp_path: Path) -> None:
    path = tmp_path / "photo.png"
    PHOTO.save(path)
    agent = scripted_agent()
    for image in (path, str(path), path.read_bytes(), np.asarray(PHOTO)):
        assert agent.predict(image, "drink").mask.sum() == 32 * 24


def test_given_answers_are_not_asked_for() -> None:
    target = Target("drink", "mug", "the rim of the mug")
    agent = scripted_agent(dream=True)
    vlm: Any = agent.thinker.vlm  # type: ignore[union-attr]
    assert agent.predict(PHOTO, "drink", given=Given(target=target)).target == target
    assert not vlm.requests
    box = Detection(np.array([[1, 1, 5, 5]], np.float32))
    assert agent.predict(PHOTO, "drink", given=Given(detection=box)).mask.sum() == 16
    region = Region(None, np.zeros((0, 2), np.float32), np.ones((48, 64), bool))
    assert agent.predict(PHOTO, "drink", given=Given(regions=(region,))).mask.all()
    assert agent.predict(PHOTO, "drink", given=Given(regions=())).status == "empty"
    assert not vlm.requests
    assert len(agent.spotter.detector.requests) == 1  # type: ignore[attr-defined]


def test_with_experts_keeps_shared_models_shared() -> None:
    agent = scripted_agent(dream=True)
    wrapped: list[Any] = []

    def wrap(expert: Any) -> Any:
        wrapped.append(expert)
        return ScriptedVLM([], id=f"wrapped {expert.id}")

    copy = agent.with_experts(wrap)
    assert len(wrapped) == len(agent.experts()) == 4
    assert copy.dreamer is not None
    assert copy.thinker is not None
    assert copy.dreamer.vlm is copy.thinker.vlm
    assert agent.thinker is not None
    assert agent.thinker.vlm is wrapped[0]


def test_closing_the_agent_closes_every_model() -> None:
    with scripted_agent(dream=True) as agent:
        pass
    assert all(expert.closed for expert in agent.experts())  # type: ignore[attr-defined]


def test_the_trace_counts_seconds_and_known_dollars() -> None:
    affordance = scripted_agent(dream=True, seconds=0.01).predict(PHOTO, "drink")
    assert affordance.trace.seconds >= 0.05
    assert affordance.trace.cost == 0.0
    assert all(len(step.prompt_hash) == 16 for step in affordance.trace.steps)
    assert output("x").startswith("### Thinking")


def judged(signal: Any, *, dream: bool = False, accept: float = 0.5, retries: int = 2, **experts: Any) -> A4Agent:
    """A scripted agent whose answers one signal judges."""
    agent = scripted_agent("the handle of the mug", dream=dream)
    spotter = Spotter(experts.get("detector") or ScriptedDetector(), ScriptedSegmenter())
    return replace(agent, spotter=spotter, verifier=Verifier((signal,), accept=accept, retries=retries))


class Judge:
    """A signal that gives one value after the other, then the last one for ever."""

    name, needs = "judge", ()

    def __init__(self, *values: float | None, blame: str = "spotter", note: str = "It is the rim.") -> None:
        self.values, self.blame, self.note, self.seen = list(values), blame, note, 0

    def measure(self, evidence: Evidence) -> list[Check]:
        value = self.values[min(self.seen, len(self.values) - 1)]
        self.seen += 1
        return [Check("judge", value, self.note, self.blame)]


def test_without_a_verifier_there_is_no_confidence() -> None:
    affordance = scripted_agent().predict(PHOTO, "drink")
    assert (affordance.status, affordance.confidence, affordance.checks) == ("ok", None, ())


def test_an_accepted_answer_is_asked_for_once() -> None:
    judge = Judge(0.9)
    affordance = judged(judge).predict(PHOTO, "drink")
    assert (affordance.status, affordance.confidence, judge.seen) == ("ok", 0.9, 1)
    assert affordance.checks == (Check("judge", 0.9, "It is the rim.", "spotter"),)


def test_an_answer_that_is_never_accepted_is_abstained_and_keeps_its_mask() -> None:
    judge = Judge(0.1, 0.3, 0.2, blame="thinker")
    affordance = judged(judge).predict(PHOTO, "drink")
    assert (affordance.status, affordance.confidence, judge.seen) == ("abstained", 0.3, 3)
    assert affordance.mask.any()
    assert affordance.summary == "unsure (0.30): the handle of the mug"


def test_the_blamed_spotter_is_asked_in_other_words_and_then_in_a_crop() -> None:
    detector = ScriptedDetector()
    affordance = judged(Judge(0.1), detector=detector).predict(PHOTO, "drink")
    phrases = [(request.phrase, request.image.size) for request in detector.requests]
    assert phrases[:2] == [("the handle of the mug", (64, 48)), ("mug handle", (64, 48))]
    assert len(phrases) == 2  # a crop about the middle half would be the whole picture
    assert [step.stage for step in affordance.trace.steps].count("thinker") == 1


def test_the_blamed_thinker_hears_the_reason() -> None:
    agent = judged(Judge(0.1, 0.8, blame="thinker"))
    affordance = agent.predict(PHOTO, "drink")
    assert affordance.status == "ok"
    first, second = agent.thinker.vlm.requests  # type: ignore[union-attr]
    assert "It is the rim." not in first.text
    assert '"the handle of the mug"' in second.text
    assert "It is the rim." in second.text
    assert [step.stage for step in affordance.trace.steps] == ["thinker", "spotter", "spotter"] * 2


def test_the_blamed_dreamer_gets_another_seed_and_all_after_it_run_again() -> None:
    agent = judged(Judge(0.1, 0.2, 0.9, blame="dreamer"), dream=True)
    affordance = agent.predict(PHOTO, "drink")
    assert affordance.status == "ok"
    assert [request.seed for request in agent.dreamer.editor.requests] == [0, 1, 2]  # type: ignore[union-attr]
    assert [step.stage for step in affordance.trace.steps] == [
        "dreamer",
        "dreamer",
        "thinker",
        "spotter",
        "spotter",
    ] * 3


@pytest.mark.parametrize(("blame", "stage"), [("dreamer", "thinker"), ("thinker", "thinker"), ("spotter", "spotter")])
def test_without_a_dreamer_the_next_stage_is_asked(blame: str, stage: str) -> None:
    affordance = judged(Judge(0.1, 0.9, blame=blame)).predict(PHOTO, "drink")
    assert [step.stage for step in affordance.trace.steps][3] == stage


def test_what_was_given_is_not_asked_again() -> None:
    judge = Judge(0.1, blame="thinker")
    given = Given(target=Target("drink", "mug", "the rim of the mug"))
    agent = judged(judge)
    assert agent.predict(PHOTO, "drink", given=given).status == "abstained"
    assert not agent.thinker.vlm.requests  # type: ignore[union-attr]
    judge.seen = 0
    box = Detection(np.array([[1, 1, 5, 5]], np.float32))
    assert agent.predict(PHOTO, "drink", given=Given(detection=box)).status == "abstained"
    assert judge.seen == 1
    region = Region(None, np.zeros((0, 2), np.float32), np.ones((48, 64), bool))
    assert agent.predict(PHOTO, "drink", given=Given(regions=(region,))).status == "ok"
    assert judge.seen == 1


@pytest.mark.parametrize(("value", "summary"), [(None, "unsure: "), (0.0, "unsure (0.00): ")])
def test_a_verifier_that_knows_nothing_ends(value: float | None, summary: str) -> None:
    judge = Judge(value)
    affordance = judged(judge, retries=5).predict(PHOTO, "drink")
    assert (affordance.status, affordance.confidence) == ("abstained", value)
    assert affordance.mask.any()
    assert judge.seen <= 3
    assert affordance.summary == f"{summary}the handle of the mug"


def test_a_retry_that_fails_keeps_the_best_so_far() -> None:
    answers = [output("the rim"), "no", "no", "no", output("the lid")]
    thinker = Thinker(ScriptedVLM(answers))
    verifier = Verifier((Judge(0.2, 0.1, blame="thinker"),))
    agent = A4Agent(None, thinker, Spotter(ScriptedDetector(), ScriptedSegmenter()), verifier=verifier)
    affordance = agent.predict(PHOTO, "drink")
    assert (affordance.status, affordance.phrase, affordance.confidence) == ("abstained", "the rim", 0.2)
    errors = [step.error for step in affordance.trace.steps if step.error]
    assert len(errors) == 1
    assert "asked 3 times" in errors[0]


def test_nothing_found_is_looked_for_in_other_words() -> None:
    detector = ScriptedDetector([[], [[4, 4, 20, 20]]])
    affordance = judged(Judge(0.9), detector=detector).predict(PHOTO, "drink")
    assert [request.phrase for request in detector.requests] == ["the handle of the mug", "mug handle"]
    assert (affordance.status, affordance.confidence) == ("ok", 0.9)
    empty = judged(Judge(0.9), detector=ScriptedDetector(lambda request: [])).predict(PHOTO, "drink")
    assert (empty.status, empty.confidence) == ("empty", None)


def test_retries_stop_when_the_caller_says_so() -> None:
    judge = Judge(0.1)
    costs: list[int] = []

    def may_retry(trace: Any) -> bool:
        costs.append(len(trace.steps))
        return False

    assert judged(judge).predict(PHOTO, "drink", may_retry=may_retry).status == "abstained"
    assert (judge.seen, costs) == (1, [3])


def test_stages_are_told_once_and_the_answer_last() -> None:
    heard: list[str] = []
    judged(Judge(0.1, blame="thinker")).predict(PHOTO, "drink", on_stage=lambda name, value: heard.append(name))
    assert heard == ["target", "detection", "affordance"]


DREAMER_FAILURES = [
    (["I'm sorry, I can't."], []),
    ([""], []),
    (["Edit it."], [ProviderUnavailable("down")]),
    ([ProviderUnavailable("down")], []),
]


@pytest.mark.parametrize(("words", "pictures"), DREAMER_FAILURES)
@pytest.mark.parametrize("required", [False, True])
def test_a_dreamer_that_fails_is_in_the_trace_and_stops_only_if_required(
    words: list[Any], pictures: list[Any], required: bool
) -> None:
    dreamer = Dreamer(ScriptedVLM(words), ScriptedEditor(pictures), required=required)
    thinker = Thinker(ScriptedVLM([output("the rim")]))
    agent = A4Agent(dreamer, thinker, Spotter(ScriptedDetector(), ScriptedSegmenter()))
    affordance = agent.predict(PHOTO, "drink")
    assert (affordance.status in ("invalid", "error")) is required
    failed = [step for step in affordance.trace.steps if step.stage == "dreamer"][-1]
    assert failed.error
    if not required:
        assert affordance.status == "ok"
        assert affordance.imagination is None
        assert len(thinker.vlm.requests[0].images) == 1  # type: ignore[attr-defined]


def test_a_dreamer_without_its_key_is_raised() -> None:
    dreamer = Dreamer(ScriptedVLM([CredentialError("no key")]), ScriptedEditor())
    with pytest.raises(CredentialError):
        A4Agent(dreamer, None, Spotter(ScriptedDetector(), ScriptedSegmenter())).predict(PHOTO, "drink")


def test_the_answer_names_picture_profile_and_version(tmp_path: Path) -> None:
    PHOTO.save(tmp_path / "mug.png")
    affordance = replace(scripted_agent(), profile="paper").predict(tmp_path / "mug.png", "drink")
    data = affordance.to_dict()
    assert (data["image_path"], data["profile"]) == (str(tmp_path / "mug.png"), "paper")
    assert data["version"] == a4agent.__version__
    assert scripted_agent().predict(PHOTO, "drink").image_path is None


def test_measured_rates_match_the_arithmetic() -> None:
    """A detector wrong with p = 0.3 and a verifier with TPR 0.9 and FPR 0.1, at most two retries.

    accepted at a try: a = 0.7 * 0.9 + 0.3 * 0.1 = 0.66; abstained: (1 - a)^3 = 0.0393; tries: 1 + 0.34 + 0.34^2.
    right: accepted with 0.63 / 0.66 = 0.9545; of three rejected the first is kept, right with 0.07 / 0.34.
    """
    rng = np.random.default_rng(7)
    truth = np.zeros((48, 64), bool)
    truth[:10, :10] = True
    detector = ScriptedDetector(lambda request: [[0, 0, 10, 10] if rng.random() < 0.7 else [30, 30, 40, 40]])

    class Rater:
        name, needs = "rater", ()

        def measure(self, evidence: Evidence) -> list[Check]:
            right = bool(evidence.affordance.mask[5, 5])
            says_yes = rng.random() < (0.9 if right else 0.1)
            return [Check("rater", float(says_yes), "", "thinker")]

    agent = judged(Rater(), detector=detector)
    n = 1000
    answers = [agent.predict(PHOTO, "drink") for _ in range(n)]
    giou = float(np.mean([iou(answer.mask, truth) for answer in answers]))
    abstained = float(np.mean([answer.status == "abstained" for answer in answers]))
    calls = len(detector.requests) / n

    def within(value: float, expected: float, deviation: float) -> bool:
        return abs(value - expected) < 3 * deviation / n**0.5

    missed = 0.34**3
    right = (1 - missed) * 0.63 / 0.66 + missed * 0.07 / 0.34
    assert within(abstained, missed, (missed * (1 - missed)) ** 0.5)
    assert within(giou, right, (right * (1 - right)) ** 0.5)
    assert within(calls, 1 + 0.34 + 0.34**2, 0.7)
    accepted = [answer for answer in answers if answer.status == "ok"]
    assert within(float(np.mean([iou(answer.mask, truth) for answer in accepted])), 0.63 / 0.66, 0.21)
