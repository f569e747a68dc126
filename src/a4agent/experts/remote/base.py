"""What the experts behind an OpenAI-compatible server share: one call a request, its price, its first choice."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar, cast

from a4agent.errors import A4Error, ConfigError, ProviderUnavailable
from a4agent.experts.remote.connection import Connection, Sent
from a4agent.experts.remote.prices import price_from_setting, price_of
from a4agent.protocols import ExpertBase
from a4agent.types import Usage

RequestT = TypeVar("RequestT")
AnswerT = TypeVar("AnswerT")


class RemoteExpert(ExpertBase):
    """An expert over a `Connection`. Calls overlap; a call carries one request. Settings that subclasses share:

        base_url: the server's address with "/v1"; "" is the usual place of `server`, or OpenAI.
        server: a name from servers.toml (openai, vllm, sglang, ollama, llama.cpp, transformers, other).
        api_key_variable: the environment variable with the key, if not the server's usual one.
        timeout: seconds without a byte until a call counts as failed.
        max_retries: repeats inside one call (408, 409, 429, 5xx, broken connections), honouring Retry-After. In a run
            the engine repeats calls instead.
        concurrency: calls that may be in flight at once.
        price: US dollars per million tokens, as {"input": 2.5, "output": 10.0}; overrides the table.
        extra: fields added to every request as they are, such as {"top_k": 1}.
        image_format, max_side, quality: how pictures are sent; see `PictureEncoder`.

    Making one raises ConfigError (a setting that does not fit), CredentialError (the server needs a key and its
    variable is not set) and MissingExtraError (the openai package is not installed).
    """

    def __init__(
        self,
        id: str,
        connection: Connection,
        *,
        settings: Mapping[str, Any],
        concurrency: int,
        price: Mapping[str, float] | None = None,
    ) -> None:
        if concurrency < 1:
            raise ConfigError(f"concurrency must be at least 1, not {concurrency!r}")
        super().__init__(id, settings=settings, max_batch=1, concurrency=concurrency)
        self._connection = connection
        listed = price_of(connection.model) if connection.server.priced else None
        self._price = price_from_setting(price) if price else listed
        self.price_known = self._price is not None

    def close(self) -> None:
        self._connection.close()

    def without_retries(self) -> RemoteExpert:
        """The same expert, which makes each call once."""
        twin = copy.copy(self)
        twin._connection = self._connection.without_retries()
        return twin

    def shutdown_date(self) -> str:
        """The day on which the model is retired, by its server or its vendor's list; "" if none is announced."""
        listed = price_of(self._connection.model) if self._connection.server.priced else None
        return self._connection.shutdown_date() or (listed.retires if listed else "")

    def _one_by_one(self, requests: Sequence[RequestT], ask: Callable[[RequestT], AnswerT]) -> list[AnswerT | A4Error]:
        """`ask` each request. An error that every request would meet is raised; any other is that request's answer."""
        answers: list[AnswerT | A4Error] = []
        for request in requests:
            try:
                answers.append(ask(request))
            except A4Error as error:
                if error.fatal:
                    raise
                answers.append(error)
        return answers

    def _first_choice(self, completion: Any) -> Any:
        choices = getattr(completion, "choices", None)
        if not isinstance(choices, list) or not choices or not hasattr(getattr(choices[0], "message", None), "content"):
            raise ProviderUnavailable(f"{self._connection} sent an answer without choices")
        return choices[0]

    def _usage(self, answer: Any, sent: Sent) -> Usage:
        """Tokens and dollars of an answer. Without the server's token counts the cost is unknown, unless it is free."""
        usage = getattr(answer, "usage", None)
        tokens_in = _count(usage, "prompt_tokens", "input_tokens")
        tokens_out = _count(usage, "completion_tokens", "output_tokens")
        cost = None
        counted = tokens_in and tokens_out is not None  # no question is without input tokens
        if self._price is not None and (counted or self._price.is_free):
            cost = self._price.cost(
                tokens_in=tokens_in or 0,
                tokens_out=tokens_out or 0,
                cached_in=_count(getattr(usage, "prompt_tokens_details", None), "cached_tokens") or 0,
                image_in=_count(getattr(usage, "input_tokens_details", None), "image_tokens") or 0,
            )
        return Usage(
            seconds=sent.seconds,
            attempts=sent.attempts,
            tokens_in=tokens_in or 0,
            tokens_out=tokens_out or 0,
            cost=cost,
            request_id=sent.request_id,
        )


def text_of(content: Any) -> str:
    """A message's text: a string, or the text parts of a list."""
    if isinstance(content, str):
        return content
    if isinstance(content, Sequence):
        parts = [part.get("text") if isinstance(part, Mapping) else getattr(part, "text", "") for part in content]
        return "".join(str(part) for part in parts if part)
    return ""


def fields_from_setting(extra: Any) -> dict[str, Any]:
    """The fields that a user adds to every request.

    Raises:
        ConfigError: not a table.
    """
    if extra is not None and not isinstance(extra, Mapping):
        raise ConfigError(f"extra = {extra!r} must be a table, such as {{top_k = 1}}")
    return dict(cast("Mapping[str, Any]", extra or {}))


def _count(usage: Any, *names: str) -> int | None:
    """The first of these counts that the server gave as a number of tokens; None if it gave none."""
    values = (getattr(usage, name, None) for name in names)
    return next((int(value) for value in values if isinstance(value, (int, float)) and 0 <= value < math.inf), None)
