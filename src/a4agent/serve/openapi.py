"""What the OpenAPI schema says beyond what the signatures do: bodies of two kinds, examples, errors, the token."""

from __future__ import annotations

import base64
import io
from functools import lru_cache
from typing import Any

from fastapi import FastAPI

from a4agent.serve import wire
from a4agent.serve.questions import BatchIn, SampleIn

DESCRIPTION = """Which part of the thing in this picture do I act on?

Send a picture and an instruction; boxes, key points and masks of the part come back, in pixels of the upright
picture. A model's mistake is an answer with the status `invalid` or `error`; nothing found is `empty`."""

STREAM_HEADERS = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}

_EVENT = {
    "type": "object",
    "description": "One server-sent event; `data` is JSON on one line.",
    "required": ["event", "data"],
    "properties": {
        "event": {"enum": ["queued", "imagination", "target", "detection", "affordance", "error"]},
        "data": {"type": "string"},
    },
}

_MEANING = {
    400: "The body cannot be parsed.",
    401: "The bearer token is missing or wrong.",
    403: "Without a token, only requests from this machine are answered.",
    408: "The upload took too long.",
    413: "Too many bytes or pixels.",
    415: "Another content type than the two that are read.",
    422: "A field or a picture that cannot be used.",
    503: "The queue is full, the time is up, or the models cannot be reached. Try again after `Retry-After` seconds.",
}


def errors(*codes: int) -> dict[int | str, dict[str, Any]]:
    """The documented error answers, each `{"error": "one sentence"}`."""
    answers: dict[int | str, dict[str, Any]] = {}
    for code in (401, 403, *codes):
        answers[code] = {"model": wire.ErrorOut, "description": _MEANING[code]}
    if 503 in answers:
        answers[503]["headers"] = {"Retry-After": {"description": "seconds", "schema": {"type": "integer"}}}
    return answers


def one() -> dict[str, Any]:
    """The keywords of the single endpoint's route."""
    form = {
        "type": "object",
        "required": ["image", "instruction"],
        "additionalProperties": False,
        "properties": {
            "image": {"type": "string", "format": "binary", "description": "the file of a picture"},
            **{name: _text_schema(name) for name in ("instruction", "part", "id")},
        },
    }
    body = {
        "required": True,
        "content": {
            "application/json": {"schema": _schema(SampleIn), "examples": {"mug": {"value": example()}}},
            "multipart/form-data": {"schema": form},
        },
    }
    answers = errors(400, 408, 413, 415, 422, 503)
    answers[200] = {
        "model": wire.AffordanceOut,
        "description": "The affordance; with `stream=1` the events `queued`, `imagination`, `target`, `detection` and"
        " `affordance` (or `error`).",
        "content": {"text/event-stream": {"schema": _EVENT}},
    }
    return {"responses": answers, "openapi_extra": {"requestBody": body}}


def batch(most: int) -> dict[str, Any]:
    """The keywords of the batch endpoint's route; a batch has `most` samples or fewer."""
    schema = _schema(BatchIn)
    schema["properties"]["samples"]["maxItems"] = most
    value = {"samples": [{**example(), "id": "left"}, {**example(), "id": "right"}]}
    content = {"application/json": {"schema": schema, "examples": {"two": {"value": value}}}}
    return {
        "responses": {
            **errors(400, 408, 413, 415, 422, 503),
            200: {"model": wire.BatchOut, "description": "One affordance a sample."},
        },
        "openapi_extra": {"requestBody": {"required": True, "content": content}},
    }


def metrics() -> dict[str, Any]:
    """The keywords of the metrics route."""
    text = {"description": "The exposition format.", "content": {"text/plain": {"schema": {"type": "string"}}}}
    return {"responses": {**errors(), 200: text}, "response_model": None}


def declare_token(app: FastAPI, needed: bool) -> None:
    """Say in the schema that requests carry a bearer token, if they have to."""
    if not needed:
        return
    make = app.openapi

    def with_token() -> dict[str, Any]:
        schema = make()
        schemes = schema.setdefault("components", {}).setdefault("securitySchemes", {})
        schemes["token"] = {"type": "http", "scheme": "bearer"}
        for path, methods in schema["paths"].items():
            for operation in methods.values():
                if path.startswith("/v1/") or path == "/metrics":
                    operation["security"] = [{"token": []}]
        return schema

    app.openapi = with_token


@lru_cache(maxsize=1)
def example() -> dict[str, str]:
    """A request that works: a small picture of a mug, and what to do with it."""
    from PIL import Image, ImageDraw

    picture = Image.new("RGB", (64, 48), "white")
    draw = ImageDraw.Draw(picture)
    draw.rectangle((14, 10, 38, 40), fill=(200, 60, 40))
    draw.arc((32, 15, 52, 35), -90, 90, fill=(200, 60, 40), width=4)
    file = io.BytesIO()
    picture.save(file, "PNG", optimize=True)
    return {"image": base64.b64encode(file.getvalue()).decode("ascii"), "instruction": "drink from the mug"}


def _text_schema(name: str) -> dict[str, Any]:
    """A text field of a form: one that may be null in JSON is left out of a form."""
    schema = _schema(SampleIn)["properties"][name]
    text = next((kind for kind in schema.get("anyOf", ()) if kind.get("type") == "string"), {})
    return {**{key: value for key, value in schema.items() if key not in ("anyOf", "default")}, **text}


def _schema(model: Any) -> dict[str, Any]:
    """A model's JSON schema with its references resolved in place."""
    schema = model.model_json_schema()
    definitions = schema.pop("$defs", {})

    def inlined(node: Any) -> Any:
        if isinstance(node, dict):
            name = node.get("$ref", "").rpartition("/")[2]
            return inlined(definitions[name]) if name else {key: inlined(value) for key, value in node.items()}
        return [inlined(item) for item in node] if isinstance(node, list) else node

    return inlined(schema)
