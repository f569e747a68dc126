"""What remote experts share: messages in parts, fields of the user's, one answer a request."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from a4agent.errors import A4Error, ConfigError, ProviderError
from a4agent.experts.remote.base import RemoteExpert, fields_from_setting, text_of


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("the handle", "the handle"),
        ([{"type": "text", "text": "the "}, {"type": "image"}, SimpleNamespace(text="handle")], "the handle"),
        ([{"text": None}], ""),
        (None, ""),
        (7, ""),
    ],
)
def test_the_text_of_a_message(content: Any, text: str) -> None:
    assert text_of(content) == text


def test_extra_fields_are_copied_and_must_be_a_table() -> None:
    extra = {"top_k": 1}
    copied = fields_from_setting(extra)
    copied["top_k"] = 2
    assert extra == {"top_k": 1}
    assert fields_from_setting(None) == {}
    with pytest.raises(ConfigError, match=r"extra = \['top_k'\] must be a table, such as \{top_k = 1\}"):
        fields_from_setting(["top_k"])


@pytest.fixture
def expert() -> RemoteExpert:
    connection: Any = SimpleNamespace(model="tiny", server=SimpleNamespace(priced=False))
    return RemoteExpert("local:tiny", connection, settings={}, concurrency=2)


def test_an_error_of_one_request_is_its_answer_and_a_fatal_one_is_raised(expert: RemoteExpert) -> None:
    def ask(request: int | A4Error) -> int:
        if isinstance(request, A4Error):
            raise request
        return 2 * request

    bad = ProviderError("no answer")
    assert expert._one_by_one([1, bad, 3], ask) == [2, bad, 6]
    bad.fatal = True
    with pytest.raises(ProviderError, match="no answer"):
        expert._one_by_one([1, bad, 3], ask)


def test_at_least_one_call_is_in_flight(expert: RemoteExpert) -> None:
    with pytest.raises(ConfigError, match="concurrency must be at least 1, not 0"):
        RemoteExpert("local:tiny", expert._connection, settings={}, concurrency=0)


def test_without_a_price_the_cost_is_unknown_unless_it_is_free(expert: RemoteExpert) -> None:
    sent: Any = SimpleNamespace(seconds=0.5, attempts=1, request_id="r1")
    answer = SimpleNamespace(usage=SimpleNamespace(prompt_tokens=1000, completion_tokens=float("nan")))
    unpriced = expert._usage(answer, sent)
    assert (unpriced.tokens_in, unpriced.tokens_out, unpriced.cost) == (1000, 0, None)
    price = {"input": 2.0, "output": 4.0}
    priced = RemoteExpert("local:tiny", expert._connection, settings={}, concurrency=1, price=price)
    assert priced._usage(answer, sent).cost is None
    answer.usage.completion_tokens = 0
    assert priced._usage(answer, sent).cost == pytest.approx(0.002)
    assert priced._usage(SimpleNamespace(), sent).cost is None
    for wrong in ({}, {"completion_tokens": 10}, {"prompt_tokens": 0, "completion_tokens": 10}, {"prompt_tokens": -5}):
        assert priced._usage(SimpleNamespace(usage=SimpleNamespace(**wrong)), sent).cost is None
    free = RemoteExpert("local:tiny", expert._connection, settings={}, concurrency=1, price=dict.fromkeys(price, 0.0))
    assert free._usage(SimpleNamespace(), sent).cost == 0.0
