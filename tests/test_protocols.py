"""What experts have in common: verbs, bookkeeping, and how one is asked."""

from __future__ import annotations

import pytest
from PIL import Image

from a4agent.errors import ProviderError
from a4agent.protocols import (
    VERBS,
    ChatAnswer,
    ChatRequest,
    DetectRequest,
    EditRequest,
    Expert,
    ExpertBase,
    Prepares,
    Prompt,
    Repeats,
    SegmentRequest,
    ask,
    with_usage,
)
from a4agent.types import Usage


class Echo(ExpertBase):
    def __init__(self) -> None:
        super().__init__("test:echo", revision="r1", settings={"loud": True}, max_batch=3, concurrency=2)
        self.asked: list[str] = []

    def chat(self, requests: list[ChatRequest]) -> list[ChatAnswer | ProviderError]:
        self.asked += [request.text for request in requests]
        return [ProviderError("no words") if not r.text else ChatAnswer(r.text) for r in requests]


@pytest.mark.parametrize("request_type", [ChatRequest, EditRequest, DetectRequest, SegmentRequest])
def test_each_request_names_the_method_of_its_role(request_type: type[ChatRequest]) -> None:
    assert VERBS[request_type.role] == request_type.verb


def test_a_batch_is_answered_in_order_with_errors_in_place() -> None:
    first, second, third = ask(Echo(), [ChatRequest((), text) for text in ("a", "", "c")])
    assert (first.text, third.text) == ("a", "c")  # pyright: ignore
    assert isinstance(second, ProviderError)


def test_nothing_asked_is_nothing_answered() -> None:
    echo = Echo()
    assert ask(echo, []) == []
    assert echo.asked == []


def test_the_base_keeps_the_books() -> None:
    echo = Echo()
    assert isinstance(echo, Expert)
    assert not isinstance(echo, Prepares)
    assert not isinstance(echo, Repeats)
    assert echo.fingerprint() == {"id": "test:echo", "revision": "r1", "settings": {"loud": True}}
    assert (echo.max_batch, echo.concurrency, repr(echo)) == (3, 2, "Echo('test:echo')")
    settings = {"threshold": 0.3}
    kept = ExpertBase("test:kept", settings=settings)
    settings["threshold"] = 0.5
    assert kept.fingerprint()["settings"] == {"threshold": 0.3}


def test_usage_is_replaced_in_a_copy() -> None:
    answer = ChatAnswer("a", usage=Usage(seconds=1.0, tokens_in=7))
    cached = with_usage(answer, cached=True, seconds=0.0)
    assert (cached.text, cached.usage.cached, cached.usage.seconds, cached.usage.tokens_in) == ("a", True, 0.0, 7)
    assert not answer.usage.cached


def test_a_prompt_may_be_a_box_alone_and_requests_compare_by_identity() -> None:
    assert Prompt().points_xy.shape == (0, 2)
    image = Image.new("RGB", (4, 4))
    assert DetectRequest(image, "the handle") != DetectRequest(image, "the handle")
