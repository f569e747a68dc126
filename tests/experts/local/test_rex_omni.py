"""Rex-Omni on a tiny model that was taught its answers: two questions in one batch, boxes read from ids."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from a4agent.errors import ConfigError, ModelFilesError
from a4agent.experts.local import rex_omni
from a4agent.protocols import DetectRequest

pytest.importorskip("torch")

PHRASE = "the handle of the mug"


@pytest.fixture(scope="module")
def detector(taught_rex_omni):
    return rex_omni.create(str(taught_rex_omni), "detector", max_new_tokens=64)


def test_boxes_and_points_of_the_taught_picture(detector, noise):
    found = detector.detect([DetectRequest(noise(96, 64), PHRASE)])[0]
    expected = np.array([[100, 200, 700, 800], [0, 0, 500, 999]]) / 999 * [96, 64, 96, 64]
    np.testing.assert_allclose(found.boxes_xyxy, expected, rtol=1e-6)
    np.testing.assert_allclose(found.points_xy, np.array([[400, 500]]) / 999 * [96, 64], rtol=1e-6)
    assert found.scores is None
    assert not found.points_derived
    assert found.text.count(PHRASE) == 2
    assert found.usage.tokens_out == (3 + len(PHRASE) + 9 + 1) + (3 + len(PHRASE) + 2 + 1)  # a token a character


def test_detection_and_pointing_share_one_batch_and_coordinates_follow_each_image(detector, noise, monkeypatch):
    detector.load()
    sizes = []
    generate = detector._model.model.generate

    def counted(**inputs):
        sizes.append(len(inputs["input_ids"]))
        rows = generate(**inputs)
        rows[2:] = rows[:2]  # the second picture is answered like the first
        return rows

    monkeypatch.setattr(detector._model.model, "generate", counted)
    picture = noise(96, 64)
    double = picture.resize((192, 128), Image.Resampling.NEAREST)
    small, large = detector.detect([DetectRequest(picture, PHRASE), DetectRequest(double, PHRASE)])
    assert sizes == [4]
    np.testing.assert_allclose(large.boxes_xyxy, small.boxes_xyxy * 2, rtol=1e-5)


@pytest.mark.parametrize("tokens", range(1, 31, 3))
def test_an_answer_cut_off_keeps_its_complete_shapes(taught_rex_omni, detector, noise, tokens):
    request = DetectRequest(noise(96, 64), PHRASE)
    short = rex_omni.create(str(taught_rex_omni), "detector", max_new_tokens=tokens)
    answer, whole = short.detect([request])[0], detector.detect([request])[0]
    assert answer.cut_off
    assert not whole.cut_off
    count = len(answer.boxes_xyxy)
    assert count <= len(whole.boxes_xyxy)
    np.testing.assert_array_equal(answer.boxes_xyxy, whole.boxes_xyxy[:count])
    np.testing.assert_array_equal(answer.points_xy, whole.points_xy[: len(answer.points_xy)])


def test_the_authors_settings(detector):
    detector.load()
    assert detector._model.processor.image_processor.size["shortest_edge"] == 16 * 28 * 28
    assert detector._model.processor.image_processor.size["longest_edge"] == 2560 * 28 * 28
    assert detector.fingerprint()["settings"]["max_new_tokens"] == 64
    assert rex_omni.create(str(detector.checkpoint.folder), "detector").settings["max_new_tokens"] == 4096


@pytest.mark.parametrize("settings", [{"max_new_tokens": 0}, {"max_pixels": 100}])
def test_settings_that_do_not_fit_are_answered(settings):
    with pytest.raises(ConfigError, match="max_pixels at least 12544"):
        rex_omni.create("IDEA-Research/Rex-Omni", "detector", **settings)


def test_another_model_is_refused(tiny_qwen_vl, tiny_sam2):
    with pytest.raises(ModelFilesError, match="is not Rex-Omni's"):
        rex_omni.create(str(tiny_qwen_vl), "detector").load()
    with pytest.raises(ModelFilesError, match="'qwen2_5_vl' is needed"):
        rex_omni.create(str(tiny_sam2), "detector")
    with pytest.raises(ModelFilesError, match="a4 models pull IDEA-Research/Rex-Omni"):
        rex_omni.create("IDEA-Research/Rex-Omni", "detector")
