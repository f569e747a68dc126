"""`openai:MODEL`: a vision-language model behind any OpenAI-compatible server.

    openai:gpt-4o                                                        OpenAI
    {expert = "openai:Qwen/Qwen2.5-VL-7B-Instruct", base_url = "http://127.0.0.1:8000/v1"}    vLLM, SGLang, ...
    {expert = "openai:qwen3-vl:8b", server = "ollama"}                   Ollama at its usual place

Images come before the text, in the order of the request, as byte-identical data URLs, so that a server can
reuse the prefix two stages share. JSON answers go down a ladder (schema, any JSON, text); what a server
refuses is remembered and not asked for again. Checking the answer is the stage's work.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from a4agent.errors import A4Error, ConfigError, RefusedAnswer, RequestRejected
from a4agent.experts.remote.base import RemoteExpert, fields_from_setting, text_of
from a4agent.experts.remote.connection import Connection, Sent
from a4agent.experts.remote.prices import price_of
from a4agent.imaging.encode import PictureEncoder
from a4agent.protocols import ChatAnswer, ChatRequest, Role

_RUNG_WORDS = ("response_format", "json_schema", "json_object", "schema", "grammar", "structured", "guided", "'json'")
_OPTIONAL = ("temperature", "seed")
_REFUSING = (400, 422, 501)
_STRUCTURE = ("type", "enum", "const", "$ref", "description")


def last_day(model: str, settings: Mapping[str, Any]) -> str:
    """The day (ISO) that the vendor announced for a model at its own server; "" if it announced none."""
    elsewhere = settings.get("base_url") or settings.get("server") not in (None, "", "openai")
    listed = None if elsewhere else price_of(model)
    return listed.retires if listed else ""


class OpenAIVLM(RemoteExpert):
    """A VLM over HTTP, by the name that the server knows it by.

    Args beyond those of `RemoteExpert`:
        structured: "auto" (the server's ladder) or one fixed rung: "json_schema", "json_object", "text".
        temperature: None leaves it to the server; it is also left out once the model has refused it.
        seed: sent if given.
        detail: OpenAI's "low" or "high" for images; "" leaves it to the server.
        text_first: send the text before the images; servers then reuse less of what they read before.
    """

    def __init__(
        self,
        model: str,
        role: Role,
        *,
        base_url: str = "",
        server: str = "",
        api_key_variable: str = "",
        structured: str = "auto",
        temperature: float | None = 0.0,
        seed: int | None = None,
        detail: str = "",
        image_format: str = "jpeg",
        max_side: int = 2048,
        quality: int = 95,
        text_first: bool = False,
        timeout: float = 120.0,
        max_retries: int = 2,
        concurrency: int = 8,
        price: Mapping[str, float] | None = None,
        extra: Mapping[str, Any] | None = None,
    ) -> None:
        connection = Connection(model, base_url, server, api_key_variable, timeout, max_retries)
        self._rungs = tuple(connection.server.structured) if structured == "auto" else (structured,)
        if not set(self._rungs) <= {"json_schema", "json_object", "text"}:
            raise ConfigError(f"structured = {structured!r}: write auto, json_schema, json_object or text")
        self._encoder = PictureEncoder(image_format, max_side, quality)
        self._extra = fields_from_setting(extra)
        optional = {"temperature": temperature, "seed": seed}
        settings = {
            "base_url": connection.base_url,
            "structured": list(self._rungs),
            **optional,
            "detail": detail,
            "text_first": text_first,
            **self._encoder.settings,
            "extra": self._extra,
        }
        super().__init__(f"openai:{model}", connection, settings=settings, concurrency=concurrency, price=price)
        self._optional = {name: value for name, value in optional.items() if value is not None}
        self._detail = {"detail": detail} if detail else {}
        self._text_first = text_first
        self._refused: set[str] = set()
        self._lock = threading.Lock()

    def chat(self, requests: Sequence[ChatRequest]) -> list[ChatAnswer | A4Error]:
        """One call a request. Errors that every request would meet are raised, others are answers."""
        return self._one_by_one(requests, self._ask)

    def _ask(self, request: ChatRequest) -> ChatAnswer:
        messages = self._messages(request)
        while True:
            rung = self._rung(request)
            fields = self._fields(request, rung)
            send = partial(_create_completion, messages=messages, **fields)
            try:
                completion, sent = self._connection.call(send)
            except RequestRejected as error:
                if not self._learn(error, rung, fields):
                    raise
            else:
                return self._read(completion, sent)

    def _messages(self, request: ChatRequest) -> list[dict[str, Any]]:
        pictures = [
            {"type": "image_url", "image_url": {"url": self._encoder.data_url(image), **self._detail}}
            for image in request.images
        ]
        system = [{"role": "system", "content": request.system}] if request.system else []
        text = {"type": "text", "text": request.text}
        content = [text, *pictures] if self._text_first else [*pictures, text]
        return [*system, {"role": "user", "content": content}]

    def _fields(self, request: ChatRequest, rung: str) -> dict[str, Any]:
        server = self._connection.server
        fields: dict[str, Any] = {"model": self._connection.model, server.max_tokens_field: request.max_tokens}
        fields |= {name: value for name, value in self._optional.items() if name not in self._refused}
        if request.attempt and "seed" in fields:
            fields["seed"] += request.attempt
        if rung == "json_schema" and request.schema is not None:
            fields["response_format"] = _schema_format(request.schema, server.schema_shape)
        elif rung == "json_object":
            fields["response_format"] = {"type": "json_object"}
        if self._extra:
            fields["extra_body"] = self._extra
        return fields

    def _rung(self, request: ChatRequest) -> str:
        if request.schema is None:
            return "text"
        return next((rung for rung in self._rungs if rung not in self._refused), "text")

    def _learn(self, error: RequestRejected, rung: str, fields: Mapping[str, Any]) -> bool:
        """Remember which optional part of the request the server refused; False if it was none of them."""
        if getattr(error.__cause__, "status_code", None) not in _REFUSING:
            return False
        said = str(error).removeprefix(str(self._connection)).lower()  # a model may be called "seed-1.6"
        refused = [name for name in _OPTIONAL if name in fields and name in said]
        if not refused and "response_format" in fields and any(word in said for word in _RUNG_WORDS):
            refused = [rung]
        with self._lock:
            self._refused.update(refused)
        return bool(refused)

    def _read(self, completion: Any, sent: Sent) -> ChatAnswer:
        choice = self._first_choice(completion)
        refusal = getattr(choice.message, "refusal", None)
        if refusal or choice.finish_reason == "content_filter":
            error = RefusedAnswer(f"{self._connection} declined: {refusal or 'stopped by its content filter'}")
            error.usage = self._usage(completion, sent)
            raise error
        kept = (getattr(choice.message, name, None) for name in self._connection.server.reasoning_fields)
        return ChatAnswer(
            text=text_of(choice.message.content),
            reasoning=next((str(value) for value in kept if value), ""),
            finish_reason="length" if choice.finish_reason == "length" else "stop",
            usage=self._usage(completion, sent),
        )


create = OpenAIVLM


def _create_completion(client: Any, **fields: Any) -> Any:
    return client.chat.completions.with_raw_response.create(**fields)


def _schema_format(schema: Mapping[str, Any], shape: str) -> dict[str, Any]:
    """The `response_format` that asks for this schema, in the subset that strict servers know."""
    strict = _strict(schema)
    if shape == "flat":
        return {"type": "json_schema", "schema": strict}
    return {"type": "json_schema", "json_schema": {"name": "answer", "strict": True, "schema": strict}}


def _strict(schema: Mapping[str, Any]) -> dict[str, Any]:
    """The structure of a JSON schema: every object requires all its properties, in order, and allows no other.

    Lengths, ranges and defaults are left out: strict servers reject them, and the answer is checked afterwards.
    """
    strict: dict[str, Any] = {key: schema[key] for key in _STRUCTURE if key in schema}
    for key in ("properties", "$defs"):
        if key in schema:
            strict[key] = {name: _strict(inner) for name, inner in schema[key].items()}
    if "items" in schema:
        strict["items"] = _strict(schema["items"])
    if "anyOf" in schema:
        strict["anyOf"] = [_strict(inner) for inner in schema["anyOf"]]
    if "properties" in strict:
        strict |= {"additionalProperties": False, "required": list(strict["properties"])}
    return strict
