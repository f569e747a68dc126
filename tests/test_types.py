"""The answer as data: derived arrays, and JSON there and back."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from a4agent import Affordance, Imagination, Region, Target, Trace
from a4agent.errors import DataError
from a4agent.types import SCHEMA, Check, Step

masks = arrays(bool, (7, 5))
boxes = st.none() | arrays(np.float32, 4, elements=st.floats(0, 100, width=16))
points = st.integers(0, 3).flatmap(lambda k: arrays(np.float32, (k, 2), elements=st.floats(0, 100, width=16)))
scores = st.none() | st.floats(0, 1)


@st.composite
def affordances(draw: st.DrawFn) -> Affordance:
    regions = draw(st.lists(st.builds(Region, boxes, points, masks, scores), max_size=3))
    return Affordance(
        instruction=draw(st.text()),
        size_wh=(5, 7),
        imagination=draw(st.none() | st.builds(Imagination, st.text(), st.none())),
        target=draw(st.none() | st.builds(Target, st.text(), st.text(), st.text(), st.text())),
        regions=tuple(regions),
        status=draw(st.sampled_from(["ok", "empty", "invalid", "error"])),
        error=draw(st.none() | st.text()),
        trace=Trace((Step("thinker", "vlm", "scripted:vlm", 0.5, cost=draw(st.none() | st.just(0.25))),)),
        id="a/b.c",
    )


@given(affordances())
def test_json_there_and_back(affordance: Affordance) -> None:
    data = json.loads(json.dumps(affordance.to_dict()))
    back = Affordance.from_dict(data)
    assert back.to_dict() == affordance.to_dict()
    assert (back.status, back.target, back.trace, back.size_wh, back.id) == (
        affordance.status,
        affordance.target,
        affordance.trace,
        affordance.size_wh,
        affordance.id,
    )
    np.testing.assert_array_equal(back.mask, affordance.mask)
    for region, copy in zip(affordance.regions, back.regions, strict=True):
        np.testing.assert_array_equal(region.mask, copy.mask)
        np.testing.assert_allclose(region.points_xy, copy.points_xy, atol=0.006)


@given(affordances())
def test_derived_arrays_have_their_shapes(affordance: Affordance) -> None:
    assert affordance.mask.shape == (7, 5)
    assert affordance.boxes_xyxy.shape == (sum(r.box_xyxy is not None for r in affordance.regions), 4)
    assert affordance.points_xy.shape == (sum(len(r.points_xy) for r in affordance.regions), 2)
    union = np.zeros((7, 5), bool)
    for region in affordance.regions:
        union |= region.mask
    np.testing.assert_array_equal(affordance.mask, union)


def test_the_tight_box_is_half_open() -> None:
    mask = np.zeros((10, 10), bool)
    mask[2:5, 3:9] = True
    tight = Region(None, np.zeros((0, 2), np.float32), mask).tight_box_xyxy
    assert tight is not None
    assert tight.tolist() == [3, 2, 9, 5]
    blank = Region(None, np.zeros((0, 2), np.float32), mask & False)
    assert blank.tight_box_xyxy is None
    assert blank.any_box_xyxy is None
    own = np.array([0, 0, 9, 9], np.float32)
    assert Region(own, np.zeros((0, 2), np.float32), mask).any_box_xyxy is own


def test_cached_steps_cost_nothing() -> None:
    spent, saved = Step("thinker", "vlm", "x", cost=0.25), Step("thinker", "vlm", "x", cost=0.25, cached=True)
    assert Trace((spent, saved)).cost == 0.25


@pytest.mark.parametrize("data", [{}, {"schema": SCHEMA}, {"schema": SCHEMA, "size_wh": "ab"}, [], None])
def test_what_is_not_an_affordance_is_refused(data: Any) -> None:
    with pytest.raises(DataError):
        Affordance.from_dict(data)


@pytest.mark.parametrize("schema", [SCHEMA - 1, SCHEMA + 1, None, "2"])
def test_another_schema_is_refused_by_its_number(schema: Any) -> None:
    data = {**Affordance("x", (5, 7)).to_dict(), "schema": schema}
    with pytest.raises(DataError, match=f"schema {schema!r}"):
        Affordance.from_dict(data)


def test_confidence_checks_and_origin_survive_json() -> None:
    checks = (Check("right_part", 0.25, "the mask covers the lid", blame="thinker"), Check("mirror", None, "not asked"))
    answer = Affordance("x", (5, 7), status="abstained", confidence=0.34, checks=checks, profile="offline")
    again = Affordance.from_dict(json.loads(json.dumps(answer.to_dict())))
    assert (again.status, again.confidence, again.checks, again.profile) == ("abstained", 0.34, checks, "offline")
    assert again.summary == "unsure (0.34): x"


def test_masks_of_another_size_than_the_image_are_refused() -> None:
    region = Region(None, np.zeros((0, 2), np.float32), np.ones((7, 5), bool))
    data = Affordance("x", (5, 7), regions=(region,)).to_dict()
    with pytest.raises(DataError, match="7 x 6"):
        Affordance.from_dict({**data, "size_wh": [6, 7]})


def test_a_saved_answer_that_is_damaged_is_our_error(tmp_path: Path) -> None:
    path = tmp_path / "affordance.json"
    for text in ("[" * 100_000, "{", '"\xff', "[]"):
        path.write_text(text, encoding="latin-1")
        with pytest.raises(DataError, match="is not a saved answer"):
            Affordance.load(tmp_path)


def test_people_read_the_reason_without_the_name_of_a_class() -> None:
    failed = Affordance("fill it", (4, 3), status="invalid", error="UnreadableAnswer: gave no JSON: 'x'")
    assert failed.reason == "gave no JSON: 'x'"
    assert failed.summary == "invalid: gave no JSON: 'x'"
    assert Affordance("fill it", (4, 3), status="error").reason == ""
