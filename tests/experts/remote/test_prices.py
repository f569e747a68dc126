"""Prices: sums that can be checked by hand, and a table that says where it is from."""

from __future__ import annotations

import datetime

import pytest

from a4agent.errors import ConfigError
from a4agent.experts.remote.prices import Price, price_from_setting, price_of
from a4agent.files import read_package_toml


def test_each_kind_of_token_has_its_price():
    price = Price(input=2.0, output=10.0, cached_input=1.0, image_input=4.0)
    assert price.cost(tokens_in=1_000_000, tokens_out=0) == 2.0
    assert price.cost(tokens_in=1_000_000, tokens_out=100_000, cached_in=400_000, image_in=100_000) == pytest.approx(
        0.5 * 2 + 0.4 * 1 + 0.1 * 4 + 0.1 * 10
    )


def test_kinds_without_a_price_of_their_own_cost_what_input_costs():
    assert Price(input=2.0, output=0.0).cost(tokens_in=500_000, tokens_out=0, cached_in=200_000) == 1.0


def test_two_calls_of_gpt_4o_cost_about_a_cent():
    price = price_of("gpt-4o")
    assert price is not None
    assert 0.004 < 2 * price.cost(tokens_in=1500, tokens_out=250) < 0.02


def test_a_dated_snapshot_has_the_price_of_its_model():
    assert price_of("gpt-4o-2024-08-06") == price_of("gpt-4o")
    first = price_of("gpt-4o-2024-05-13")
    assert first is not None
    assert (first.input, first.output) == (5.0, 15.0)
    assert price_of("gpt-4o-tuned") is None
    assert price_of("Qwen/Qwen2.5-VL-7B-Instruct") is None


def test_every_price_says_when_and_where():
    for model in read_package_toml("a4agent.experts.remote", "prices.toml"):
        price = price_of(model)
        assert price is not None
        assert datetime.date.fromisoformat(price.as_of) <= datetime.date(2026, 12, 31)
        assert price.source
        assert 0 < price.input <= price.output


@pytest.mark.parametrize(
    "price",
    [
        {},
        {"input": 1},
        {"input": 1, "output": -1},
        {"input": 1, "output": 1, "cached": 1},
        {"input": "1", "output": 1},
        5,
    ],
)
def test_an_invalid_price_raises(price):
    with pytest.raises(ConfigError, match="million tokens"):
        price_from_setting(price)
