"""The signals on pictures whose answer is known: values, calls, and what a retry asks differently."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageDraw

from a4agent.protocols import DetectRequest
from a4agent.stages.recorder import Recorder
from a4agent.stages.signals import (
    Crop,
    Evidence,
    ImaginedChange,
    MaskGeometry,
    Mirror,
    PredictedIou,
    Rewording,
    Score,
    SecondDetector,
    SecondSegmenter,
    changed_area,
    crop_around,
    locate_differently,
    reworded,
    signals,
)
from a4agent.stages.spotter import Spotter
from a4agent.testing import ScriptedDetector, ScriptedSegmenter
from a4agent.types import Affordance, Check, Detection, Imagination, Region, Target

PHOTO = Image.new("RGB", (80, 60), "grey")
ImageDraw.Draw(PHOTO).rectangle((50, 20, 59, 39), fill="red")  # the part, 10 x 20


def red_box(request: DetectRequest) -> list[Any]:
    """A detector that finds the red part wherever it is."""
    red = np.asarray(request.image)[..., 0] > 200
    rows, columns = np.flatnonzero(red.any(1)), np.flatnonzero(red.any(0))
    return [[columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]] if len(rows) else []


def evidence(detector: Any = red_box, phrase: str = "the handle of the mug") -> Evidence:
    spotter = Spotter(ScriptedDetector(detector), ScriptedSegmenter())
    regions = Spotter(ScriptedDetector(red_box), ScriptedSegmenter()).locate(PHOTO, "x")
    answer = Affordance("drink", (80, 60), target=Target("drink", "mug", phrase), regions=regions, image=PHOTO)
    return Evidence(answer, spotter, Recorder())


def value_of(checks: Any) -> float | None:
    (check,) = checks
    return check.value


def region(mask: np.ndarray, box: Any = None, points: Any = (), **more: Any) -> Region:
    box = None if box is None else np.array(box, np.float32)
    return Region(box, np.array(points, np.float32).reshape(-1, 2), mask, **more)


def test_geometry_of_an_answer_that_fits_and_of_one_that_does_not() -> None:
    mask = np.zeros((60, 80), bool)
    mask[20:40, 50:60] = True
    fits = evidence()
    good = {c.name: c.value for c in MaskGeometry().measure(fits)}
    assert good == {"point_in_mask": None, "mask_in_box": 1.0, "plausible_area": 1.0}
    odd = region(mask, box=[50, 20, 70, 60], points=[[55, 30], [5, 5], [80, 60], [50, 20]])
    answer = Affordance("x", (80, 60), regions=(odd,), image=PHOTO)
    checks = MaskGeometry().measure(Evidence(answer, fits.spotter, Recorder()))
    assert [round(c.value or 0.0, 4) for c in checks] == [0.5, 0.25, 1.0]
    assert [c.blame for c in checks] == ["spotter"] * 3
    whole = Affordance("x", (80, 60), regions=(region(np.ones((60, 80), bool)),), image=PHOTO)
    assert MaskGeometry().measure(Evidence(whole, fits.spotter, Recorder()))[2].value == 0.0
    dot = Affordance("x", (800, 600), regions=(region(np.arange(480_000).reshape(600, 800) < 24),), image=PHOTO)
    assert MaskGeometry().measure(Evidence(dot, fits.spotter, Recorder()))[2].value == pytest.approx(0.1)


def test_scores_are_the_models_own() -> None:
    mask = np.ones((60, 80), bool)
    regions = (region(mask, score=0.4, predicted_iou=0.9), region(mask, score=1.7, predicted_iou=0.7), region(mask))
    seen = Evidence(Affordance("x", (80, 60), regions=regions, image=PHOTO), evidence().spotter, Recorder())
    assert value_of(Score().measure(seen)) == pytest.approx(0.7)
    assert value_of(PredictedIou().measure(seen)) == pytest.approx(0.8)
    bare = Evidence(Affordance("x", (80, 60), regions=regions[2:], image=PHOTO), evidence().spotter, Recorder())
    assert value_of(Score().measure(bare)) is None
    assert value_of(PredictedIou().measure(bare)) is None


@pytest.mark.parametrize("signal", [Rewording(), Mirror(), Crop(), SecondDetector(), SecondSegmenter()])
def test_a_stable_answer_agrees_with_itself(signal: Any) -> None:
    seen = evidence(detector=red_box)
    others = ScriptedDetector(red_box), ScriptedSegmenter()
    seen = Evidence(seen.affordance, seen.spotter, seen.recorder, None, *others)
    (check,) = signal.measure(seen)
    assert check.value == pytest.approx(1.0)
    assert (check.name, check.blame) == (signal.name, "spotter")
    assert {step.stage for step in seen.recorder.trace.steps} == {"verifier"}


@pytest.mark.parametrize("signal", [Rewording(), Mirror(), Crop(), SecondDetector()])
def test_an_answer_that_cannot_be_repeated_does_not(signal: Any) -> None:
    nowhere = ScriptedDetector(lambda request: [[0, 0, 5, 5]])
    seen = evidence(detector=lambda request: [[0, 0, 5, 5]])
    seen = Evidence(seen.affordance, seen.spotter, seen.recorder, None, nowhere)
    assert value_of(signal.measure(seen)) == 0.0


def test_the_mirrored_picture_is_asked_for_the_other_side() -> None:
    seen = evidence(phrase="the left drawer, not the right one")
    Mirror().measure(seen)
    (step,) = [step for step in seen.recorder.trace.steps if step.role == "detector"]
    assert step.prompt == "the right drawer, not the left one"


def test_a_part_that_fills_the_picture_is_not_cropped() -> None:
    seen = evidence()
    whole = Affordance("x", (80, 60), regions=(region(np.ones((60, 80), bool)),), image=PHOTO)
    assert value_of(Crop().measure(Evidence(whole, seen.spotter, Recorder()))) is None


@pytest.mark.parametrize(
    ("phrase", "name", "other"),
    [
        ("the handle of the mug", "mug", "mug handle"),
        ("the handle of a mug", "", "mug handle"),
        ("the mug handle", "mug", "the handle of the mug"),
        ("the knob", "drawer", "the knob of the drawer"),
        ("the drawer", "drawer", "drawer"),
        ("drawer", "drawer", "the drawer"),
        ("the red knob", "", "red knob"),
        ("knob", "", "the knob"),
    ],
)
def test_other_words_for_the_same_part(phrase: str, name: str, other: str) -> None:
    assert reworded(phrase, Target("t", name, phrase) if name else None) == other
    assert reworded(phrase, Target("t", name, phrase) if name else None) != phrase


def test_what_the_dreamer_changed() -> None:
    edited = PHOTO.copy()
    ImageDraw.Draw(edited).rectangle((40, 10, 69, 49), fill="white")
    changed = changed_area(PHOTO, edited.resize((160, 120)))
    assert changed[25, 55]
    assert not changed[5, 5]
    seen = evidence()
    for picture, value in ((edited, pytest.approx(1.0)), (PHOTO, None), (None, None)):
        answer = Affordance("x", (80, 60), Imagination("Edit", picture), regions=seen.affordance.regions, image=PHOTO)
        assert value_of(ImaginedChange().measure(Evidence(answer, seen.spotter, Recorder()))) == value
    elsewhere = PHOTO.copy()
    ImageDraw.Draw(elsewhere).rectangle((0, 0, 20, 20), fill="white")
    answer = Affordance("x", (80, 60), Imagination("Edit", elsewhere), regions=seen.affordance.regions, image=PHOTO)
    (check,) = ImaginedChange().measure(Evidence(answer, seen.spotter, Recorder()))
    assert (check.value, check.blame) == (0.0, "dreamer")


def test_an_edit_in_another_light_is_not_a_change() -> None:
    rng = np.random.default_rng(0)
    photo = rng.integers(40, 180, (60, 80, 3)).astype(np.uint8)
    brighter = Image.fromarray(photo + 30)
    assert not changed_area(Image.fromarray(photo), brighter).any()


def test_a_crop_has_room_around_the_mask() -> None:
    mask = np.zeros((60, 80), bool)
    mask[20:40, 50:60] = True
    assert crop_around(mask, margin=0.5) == (42, 10, 68, 50)
    assert crop_around(mask & False, margin=0.5) is None
    assert crop_around(~mask, margin=0.5) is None


def test_the_spotter_is_asked_in_other_words_then_in_a_crop_then_no_more() -> None:
    seen = evidence()
    recorder = Recorder()
    found = [locate_differently(seen.spotter, seen.affordance, recorder, retry) for retry in (1, 2, 3)]
    assert [step.prompt for step in recorder.trace.steps if step.role == "detector"] == [
        "mug handle",
        "the handle of the mug",
    ]
    first, second, none = found
    assert none is None
    for regions in (first, second):
        assert regions is not None
        (again,) = regions
        np.testing.assert_array_equal(again.mask, seen.affordance.mask)
        assert again.box_xyxy is not None
        assert again.box_xyxy.tolist() == [50, 20, 60, 40]
    detection = Detection(np.array([[0, 0, 20, 20]], np.float32), np.array([[3, 4]], np.float32))
    spotter = Spotter(ScriptedDetector([detection]), ScriptedSegmenter())
    (moved,) = locate_differently(spotter, seen.affordance, recorder, 2)  # type: ignore[misc]
    x0, y0, _, _ = crop_around(seen.affordance.mask, margin=1.0)  # type: ignore[misc]
    assert moved.points_xy.tolist() == [[x0 + 3, y0 + 4]]


def test_built_in_signals_are_entry_points_that_name_themselves() -> None:
    assert {name: signals.find(name)().name for name in signals.names()} == {name: name for name in signals.names()}
    assert {"geometry", "review", "mirror", "second_detector"} <= set(signals.names())


def test_a_stranger_adds_a_signal() -> None:
    class Blue:
        name, needs = "blue", ()

        def measure(self, evidence: Evidence) -> list[Check]:
            return [Check("blue", 0.25, "it is not blue")]

    signals.register("blue", Blue)
    try:
        assert value_of(signals.find("blue")().measure(evidence())) == 0.25
    finally:
        del signals.added["blue"]


def test_scores_outside_0_to_1_are_clipped() -> None:
    mask = np.ones((60, 80), bool)
    for given, value in ((-3.0, 0.0), (1.7, 1.0), (0.4, 0.4)):
        regions = (region(mask, score=given, predicted_iou=given),)
        seen = Evidence(Affordance("x", (80, 60), regions=regions, image=PHOTO), evidence().spotter, Recorder())
        assert value_of(Score().measure(seen)) == value_of(PredictedIou().measure(seen)) == pytest.approx(value)


def test_a_box_without_a_mask_does_not_fit() -> None:
    blank = region(np.zeros((60, 80), bool), box=[0, 0, 9, 9])
    seen = Evidence(Affordance("x", (80, 60), regions=(blank,), image=PHOTO), evidence().spotter, Recorder())
    assert {c.name: c.value for c in MaskGeometry().measure(seen)}["mask_in_box"] == 0.0


@pytest.mark.parametrize(("rows", "value"), [(60, 0.0), (48, 0.5), (36, 1.0), (18, 1.0)])
def test_a_mask_of_most_of_the_picture_is_implausible(rows: int, value: float) -> None:
    mask = np.zeros((60, 80), bool)
    mask[:rows] = True
    answer = Affordance("x", (80, 60), regions=(region(mask),), image=PHOTO)
    checks = MaskGeometry().measure(Evidence(answer, evidence().spotter, Recorder()))
    assert checks[-1].value == pytest.approx(value)


def test_the_second_retry_looks_at_a_crop_with_the_masks_own_size_around_it() -> None:
    seen = evidence()
    detector = ScriptedDetector()
    locate_differently(replace(seen.spotter, detector=detector), seen.affordance, Recorder(), 2)
    frame = crop_around(seen.affordance.mask, margin=1.0)
    assert frame is not None
    x0, y0, x1, y1 = frame
    assert detector.requests[0].image.size == (x1 - x0, y1 - y0)
    assert frame != crop_around(seen.affordance.mask, margin=2.0)
