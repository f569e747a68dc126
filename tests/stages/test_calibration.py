"""Calibration files: the maths against numbers worked out by hand, and every file that is none refused."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from a4agent.errors import ConfigError
from a4agent.stages.calibration import Calibration, load_calibration, read_calibration, values_of
from a4agent.types import Check

LOGISTIC = Calibration("logistic", ("mirror", "score"), (2.0, -1.0), fill=(0.5, 0.25), intercept=0.5)
ISOTONIC = Calibration("isotonic", ("mirror",), (1.0,), fill=(0.0,), knots=((0.2, 0.1), (0.6, 0.3), (0.8, 0.9)))


@pytest.mark.parametrize(
    ("values", "score"),
    [
        ({"mirror": 1.0, "score": 0.5, "other": 9.0}, 0.5 + 2.0 - 0.5),
        ({"mirror": 1.0, "score": None}, 0.5 + 2.0 - 0.25),
        ({}, 0.5 + 1.0 - 0.25),
        ({"mirror": -1.0, "score": 0.0}, 0.5 - 2.0),
    ],
)
def test_logistic_is_the_weighted_sum_through_the_logistic_function(values: Any, score: float) -> None:
    assert LOGISTIC.score(values) == pytest.approx(score)
    assert LOGISTIC.probability(values) == pytest.approx(1 / (1 + math.exp(-score)))


@pytest.mark.parametrize(
    ("value", "probability"), [(0.0, 0.1), (0.2, 0.1), (0.4, 0.2), (0.6, 0.3), (0.7, 0.6), (0.8, 0.9), (1.0, 0.9)]
)
def test_isotonic_is_a_line_through_its_knots(value: float, probability: float) -> None:
    assert ISOTONIC.probability({"mirror": value}) == pytest.approx(probability)


@given(st.floats(-1e6, 1e6))
def test_a_probability_lies_between_0_and_1(value: float) -> None:
    assert 0 <= LOGISTIC.probability({"mirror": value}) <= 1
    assert 0 <= ISOTONIC.probability({"mirror": value}) <= 1


@pytest.mark.parametrize("calibration", [LOGISTIC, ISOTONIC])
def test_files_round_trip(tmp_path: Path, calibration: Calibration) -> None:
    path = tmp_path / "fit.json"
    path.write_text(json.dumps({**calibration.to_dict(), "data": "umd", "protocol": "strict"}))
    again = load_calibration(path)
    assert again == calibration
    assert again.card == {"data": "umd", "protocol": "strict"}
    assert len(again.sha256) == 64


def test_checks_become_values_by_name() -> None:
    assert values_of([Check("mirror", 0.4, "x"), Check("score", None, "y")]) == {"mirror": 0.4, "score": None}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"schema": 9}, "schema 1"),
        ({"kind": "forest"}, "kind"),
        ({"features": "mirror"}, "features"),
        ({"coefficients": [1.0]}, "coefficients must be a list of 2"),
        ({"coefficients": [1.0, float("nan")]}, "nan"),
        ({"coefficients": [1.0, True]}, "True"),
        ({"fill": None}, "fill"),
        ({"intercept": "0"}, "intercept"),
        ({"kind": "isotonic"}, "knots"),
        ({"kind": "isotonic", "knots": [[0.5, 0.2], [0.1, 0.9]]}, "rise"),
        ({"kind": "isotonic", "knots": [[0.1, 0.2], [0.5, 0.1]]}, "rise"),
        ({"kind": "isotonic", "knots": [[0.1, 0.2], [0.5, 1.1]]}, "probabilities"),
        ({"kind": "isotonic", "knots": [[0.1]]}, "unpack"),
    ],
)
def test_a_damaged_file_is_refused_with_the_field(tmp_path: Path, change: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        read_calibration({**LOGISTIC.to_dict(), **change})
    path = tmp_path / "fit.json"
    path.write_text(json.dumps({**LOGISTIC.to_dict(), **change}))
    with pytest.raises(ConfigError, match="a4 calibrate"):
        load_calibration(path)


@pytest.mark.parametrize("content", [b"", b"[]", b"{", b"\xff", b"[" * 100_000])
def test_what_is_not_json_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "fit.json"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match="is not a calibration"):
        load_calibration(path)


def test_a_missing_file_says_how_to_get_one() -> None:
    with pytest.raises(ConfigError, match=r"'nowhere\.json'.*a4 calibrate"):
        load_calibration("nowhere.json")


def test_a_file_without_an_intercept_has_0() -> None:
    data = {key: value for key, value in LOGISTIC.to_dict().items() if key != "intercept"}
    assert read_calibration(data).intercept == 0.0
