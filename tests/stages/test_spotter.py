"""The Spotter with scripted models: what it asks, what it keeps, and every odd answer a detector gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from a4agent.errors import ConfigError, ProviderError, ProviderUnavailable
from a4agent.protocols import Segmentation
from a4agent.stages.recorder import Recorder
from a4agent.stages.spotter import Spotter
from a4agent.testing import ScriptedDetector, ScriptedSegmenter
from a4agent.types import Detection, Region

PHOTO = Image.new("RGB", (64, 48), "grey")


def found(boxes: object = (), points: object = (), **more: object) -> Detection:
    return Detection(
        np.array(boxes, np.float32).reshape(-1, 4),
        np.array(points, np.float32).reshape(-1, 2),
        **more,  # type: ignore[arg-type]
    )


def test_one_segmenter_call_for_all_regions() -> None:
    detector = ScriptedDetector([found([[0, 0, 10, 10], [20, 20, 40, 40]], [[30, 30], [5, 5]])])
    segmenter = ScriptedSegmenter()
    regions = Spotter(detector, segmenter).locate(PHOTO, "the handles")
    assert [request.phrase for request in detector.requests] == ["the handles"]
    assert [len(request.prompts) for request in segmenter.requests] == [2]
    assert [region.points_xy.tolist() for region in regions] == [[[5, 5]], [[30, 30]]]
    assert [int(region.mask.sum()) for region in regions] == [100, 400]


def test_the_candidate_with_the_highest_predicted_iou_is_kept() -> None:
    masks = np.zeros((1, 3, 48, 64), bool)
    masks[0, 1, 5:9, 5:9] = True
    answer = Segmentation(masks, np.array([[0.2, 0.8, float("nan")]], np.float32))
    (region,) = Spotter(ScriptedDetector([found([[0, 0, 20, 20]])]), ScriptedSegmenter([answer])).locate(PHOTO, "x")
    assert region.mask.sum() == 16
    assert region.score == pytest.approx(0.8)


def test_the_detectors_score_goes_before_the_segmenters() -> None:
    detection = found([[50, 0, 50, 9], [0, 0, 10, 10]], scores=np.array([0.9, 0.4], np.float32))
    (region,) = Spotter(ScriptedDetector([detection]), ScriptedSegmenter()).locate(PHOTO, "x")
    assert region.score == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("detection", "pairing", "boxes"),
    [
        (found(), "optimal", []),
        (found([[5, 5, 15, 15]]), "optimal", [[5, 5, 15, 15]]),
        (found((), [[5, 5]]), "optimal", [None]),
        (found([[15, 15, 5, 5]]), "optimal", [[5, 5, 15, 15]]),
        (found([[100, 100, 200, 200]], [[300, 300]]), "optimal", []),
        (found([[-10, -10, 10, 10]]), "optimal", [[0, 0, 10, 10]]),
        (found([[np.nan, 0, 10, 10]]), "optimal", []),
        (found([[5, 5, 15, 15]]), "paper", []),
        (found([[5, 5, 15, 15]], [[8, 8], [30, 30]]), "paper", [None, None]),
        (found([[5, 5, 15, 15]], [[40, 40]]), "paper", [[5, 5, 15, 15]]),
        (found([[5, 5, 15, 15]], [[40, 40]]), "optimal", [[5, 5, 15, 15], None]),
    ],
)
def test_odd_detections_have_a_defined_result(detection: Detection, pairing: str, boxes: list[object]) -> None:
    segmenter = ScriptedSegmenter()
    regions = Spotter(ScriptedDetector([detection]), segmenter, pairing).locate(PHOTO, "x")  # type: ignore[arg-type]
    assert [None if r.box_xyxy is None else r.box_xyxy.tolist() for r in regions] == boxes
    assert all(r.mask.shape == (48, 64) and r.mask.dtype == bool for r in regions)
    assert len(segmenter.requests) == bool(boxes)


def test_a_detector_that_segments_needs_no_segmenter() -> None:
    masks = np.zeros((2, 48, 64), bool)
    masks[1, 10:20, 10:20] = True
    detection = found([[9, 9, 9, 20], [10, 10, 20, 20]], [[12, 12], [50, 40]], masks=masks)
    (region,) = Spotter(ScriptedDetector([detection]), None).locate(PHOTO, "x")
    assert region.mask.sum() == 100
    assert region.points_xy.tolist() == [[12, 12]]


def test_boxes_without_any_masks_say_what_to_set() -> None:
    with pytest.raises(ConfigError, match=r"spotter\.segmenter"):
        Spotter(ScriptedDetector([found([[0, 0, 9, 9]])]), None).locate(PHOTO, "x")


def test_masks_of_another_size_are_the_segmenters_failure() -> None:
    wrong = Segmentation(np.zeros((1, 1, 10, 10), bool), np.ones((1, 1), np.float32))
    with pytest.raises(ProviderError, match=r"10, 10"):
        Spotter(ScriptedDetector(), ScriptedSegmenter([wrong])).locate(PHOTO, "x")


@pytest.mark.parametrize(
    "detection",
    [
        found([[0, 0, 9, 9], [1, 1, 5, 5]], scores=np.array([0.5], np.float32)),
        found([[0, 0, 9, 9]], scores=np.array([0.5, 0.4], np.float32)),
        found([[0, 0, 9, 9], [1, 1, 5, 5]], masks=np.zeros((1, 48, 64), bool)),
        found([[0, 0, 9, 9]], masks=np.zeros((48, 64), bool)),
        Detection(np.array([[1, 2, 3, {}]], object)),
        Detection(np.array([1, 2, 3], np.float32)),
    ],
)
def test_arrays_that_do_not_fit_each_other_are_the_detectors_failure(detection: Detection) -> None:
    with pytest.raises(ProviderError, match="do not fit"):
        Spotter(ScriptedDetector([detection]), ScriptedSegmenter()).locate(PHOTO, "x")


@pytest.mark.parametrize(("candidates", "qualities"), [(0, (1, 0)), (3, (1,)), (3, (1, 1)), (1, (1, 3))])
def test_candidates_without_a_quality_each_are_the_segmenters_failure(
    candidates: int, qualities: tuple[int, ...]
) -> None:
    wrong = Segmentation(np.zeros((1, candidates, 48, 64), bool), np.ones(qualities, np.float32))
    with pytest.raises(ProviderError):
        Spotter(ScriptedDetector(), ScriptedSegmenter([wrong])).locate(PHOTO, "x")


def test_an_error_in_a_batch_is_raised_for_its_request() -> None:
    with pytest.raises(ProviderUnavailable, match="down"):
        Spotter(ScriptedDetector([ProviderUnavailable("down")]), ScriptedSegmenter()).locate(PHOTO, "x")


def test_a_given_detection_is_not_asked_for() -> None:
    detector = ScriptedDetector([])
    (region,) = Spotter(detector, ScriptedSegmenter()).locate(PHOTO, "x", detection=found([[0, 0, 4, 4]]))
    assert region.mask.sum() == 16
    assert not detector.requests


def test_a_non_finite_score_becomes_none() -> None:
    answer = Segmentation(np.ones((1, 1, 48, 64), bool), np.full((1, 1), np.nan, np.float32))
    (region,) = Spotter(ScriptedDetector([found([[0, 0, 9, 9]])]), ScriptedSegmenter([answer])).locate(PHOTO, "x")
    assert region.score is None
    unsure = found([[0, 0, 9, 9]], scores=[np.nan], masks=[np.ones((48, 64), np.uint8)])
    (region,) = Spotter(ScriptedDetector([unsure]), None).locate(PHOTO, "x")
    assert region.score is None
    assert region.mask.all()


def test_boxes_alone_prompt_the_segmenter_when_the_points_are_derived() -> None:
    """On a ring the middle of the box is a hole: no click there, and the key point lies in the mask."""
    ring = np.zeros((1, 1, 48, 64), bool)
    ring[..., 5:25, 5:25] = True
    ring[..., 9:21, 9:21] = False
    segmenter = ScriptedSegmenter([Segmentation(ring, np.full((1, 1), 0.9, np.float32))])
    detection = found([[5, 5, 25, 25]], [[15, 15]], points_derived=True)
    (region,) = Spotter(ScriptedDetector([detection]), segmenter).locate(PHOTO, "the handle")
    (prompt,) = segmenter.requests[0].prompts
    assert prompt.points_xy.shape == (0, 2)
    ((x, y),) = region.points_xy.astype(int)
    assert region.mask[y, x]


def test_predicted_iou_is_kept_beside_the_detectors_score() -> None:
    detection = found([[0, 0, 10, 10]], scores=np.array([0.4], np.float32))
    (region,) = Spotter(ScriptedDetector([detection]), ScriptedSegmenter()).locate(PHOTO, "x")
    assert (region.score, region.predicted_iou) == (pytest.approx(0.4), pytest.approx(0.9))


def test_segmenting_again_keeps_boxes_and_points() -> None:
    spotter = Spotter(ScriptedDetector([found([[0, 0, 10, 10]], [[3, 3]])]), ScriptedSegmenter())
    regions = spotter.locate(PHOTO, "x")
    half = Segmentation(regions[0].mask[None, None] & (np.arange(64) < 5), np.full((1, 1), 0.7, np.float32))
    recorder = Recorder()
    (again,) = replace(spotter, segmenter=ScriptedSegmenter([half])).segment_again(PHOTO, regions, recorder, "verifier")
    assert (again.mask.sum(), again.points_xy.tolist()) == (50, [[3, 3]])
    assert recorder.trace.steps[0].stage == "verifier"


def test_the_clean_detection_is_told() -> None:
    heard: list[Detection] = []
    detector = ScriptedDetector([found([[20, 20, 5, 5], [9, 9, 9, 9]], [[99, 99]])])
    Spotter(detector, ScriptedSegmenter()).locate(PHOTO, "x", on_detection=heard.append)
    (detection,) = heard
    assert detection.boxes_xyxy.tolist() == [[5, 5, 20, 20]]
    assert detection.points_xy.shape == (0, 2)


def test_nothing_prompted_is_not_segmented_again() -> None:
    segmenter = ScriptedSegmenter()
    bare = Region(None, np.zeros((0, 2), np.float32), np.ones((48, 64), bool))
    assert Spotter(ScriptedDetector(), segmenter).segment_again(PHOTO, [bare], Recorder()) == ()
    assert not segmenter.requests
