"""The truth of a picture, checked against the renderer in ways that the maker does not use."""

from __future__ import annotations

import numpy as np
import pytest

from a4agent.errors import ConfigError, DataError
from a4agent.sim import draw
from a4agent.sim.catalogue import Catalogue
from a4agent.sim.draw import LEAST_PIXELS, LEAST_VISIBLE, Drawn, Plan, draw_sample, plan_set

NAMES = ["drawer", "sink cabinet", "dial"]


def test_the_shares_add_up(drawn: dict[str, Drawn]) -> None:
    for sample in drawn.values():
        shares = sample.shares
        assert shares.visible + shares.occluded + shares.cut == pytest.approx(1)
        assert min(shares.visible, shares.occluded, shares.cut) >= 0
        assert shares.visible >= LEAST_VISIBLE
        assert (sample.regions > 0).sum() >= LEAST_PIXELS


def test_a_plan_draws_the_same_sample_again(catalogue: Catalogue, drawn: dict[str, Drawn]) -> None:
    again = draw_sample(catalogue, drawn["dial"].plan)
    for field in ("image", "regions", "thing", "depth"):
        assert np.array_equal(getattr(again, field), getattr(drawn["dial"], field))


def test_a_part_that_only_shows_from_behind_is_never_emitted(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(draw, "SCENES", 3)
    drawer = catalogue.thing("drawer")
    hidden = drawer.model_copy(update={"front": 90.0, "spread": 2.0, "joints": {}, "elevation": (5.0, 10.0)})
    with pytest.raises(DataError, match="'drawer': the part 'handle' was hidden or tiny in all"):
        draw_sample(catalogue, Plan(0, 0, hidden, hidden.tasks[0]))


def test_all_things_come_before_any_comes_again(catalogue: Catalogue) -> None:
    for split in ("dev", "test", None):
        names = [thing.name for thing in catalogue.split(split)]
        plans = list(plan_set(catalogue, 4 * len(names), 11, split))
        for turn in range(4):
            shown = [plan.thing.name for plan in plans[turn * len(names) : (turn + 1) * len(names)]]
            assert sorted(shown) == sorted(names)
        for name in names:
            tasks = [plan.task for plan in plans if plan.thing.name == name]
            assert len({task.say for task in tasks}) == len(catalogue.thing(name).tasks)


def test_a_larger_set_begins_like_a_smaller_one(catalogue: Catalogue) -> None:
    assert list(plan_set(catalogue, 50, 2, "test"))[:10] == list(plan_set(catalogue, 10, 2, "test"))


def test_files_are_named_after_any_thing(catalogue: Catalogue) -> None:
    thing = catalogue.thing("drawer")
    for name, stem in (("box lid", "0007-box-lid"), ("../a/b: Tür", "0007--a-b-Tür")):
        assert Plan(0, 7, thing.model_copy(update={"name": name}), thing.tasks[0]).stem == stem


def test_an_empty_split_is_refused(catalogue: Catalogue) -> None:
    only_dev = catalogue.model_copy(update={"things": catalogue.split("dev")})
    with pytest.raises(ConfigError, match="no thing is declared for the split 'test'"):
        list(plan_set(only_dev, 3, 0, "test"))
