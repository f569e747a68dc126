"""The description of the HTTP API: additions to FastAPI's OpenAPI schema, and `/docs`, a page without scripts."""

from __future__ import annotations

import base64
import html
import json
from functools import lru_cache
from typing import Any

from PIL import Image, ImageDraw

from a4agent.imaging.encode import encoded
from a4agent.serve import messages

DESCRIPTION = """Which part of the thing in this picture do I act on?

Send a picture and an instruction; boxes, key points and masks of the part come back, in pixels of the upright
picture. A model's mistake is an answer with the status `invalid` or `error`; nothing found is `empty`; a guess that
the Verifier did not accept is `abstained`."""

_STYLE = (
    "<style>body{font:16px/1.5 system-ui,sans-serif;max-width:52rem;margin:2rem auto;padding:0 1rem;color-scheme:"
    "light dark}code,pre{font:.88em ui-monospace,monospace}pre{overflow:auto;padding:.7rem 1rem;border:1px solid #8886;"
    "border-radius:8px}table{border-collapse:collapse;width:100%}td,th{text-align:left;vertical-align:top;padding:"
    ".25rem .8rem .25rem 0;border-bottom:1px solid #8884}h2{margin-top:2.2rem}</style>"
)
_HEAD = (
    f'<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">{_STYLE}'
)
INDEX = (
    f"{_HEAD}<title>a4agent</title><h1>a4agent</h1>"
    "<p>This server finds the part of an object to act on: send a picture and an instruction to"
    " <code>POST /v1/affordances</code>, and boxes, key points and masks come back.</p>"
    '<p><a href="/docs">How to call it</a> · <a href="/openapi.json">OpenAPI schema</a> ·'
    ' <a href="/readyz">Is it ready?</a></p>'
)

_MEANING = {
    400: "The body cannot be parsed.",
    401: "The bearer token is missing or wrong.",
    403: "Without a token, only requests from this machine are answered.",
    408: "The upload took too long.",
    413: "Too many bytes or pixels.",
    415: "A content type that is not read here.",
    422: "A field or a picture that cannot be used.",
    503: "The queue is full, the time is up, or the models cannot be reached. Try again after `Retry-After` seconds.",
}


def errors(*codes: int) -> dict[int | str, dict[str, Any]]:
    """The documented error answers, each `{"error": "one sentence"}`."""
    answers: dict[int | str, dict[str, Any]] = {
        code: {"model": messages.ErrorOut, "description": _MEANING[code]} for code in (401, 403, *codes)
    }
    if 503 in answers:
        answers[503]["headers"] = {"Retry-After": {"description": "seconds", "schema": {"type": "integer"}}}
    return answers


def one_extra() -> dict[str, Any]:
    """The two kinds of body of the single endpoint and its stream, which FastAPI cannot read from a signature."""
    sample = messages.SampleIn.model_json_schema()
    sample["properties"]["camera"]["anyOf"][0] = sample.pop("$defs")["CameraIn"]  # a body of ours has no definitions
    fields = {name: dict(schema) for name, schema in sample["properties"].items()}
    fields["image"] = {"type": "string", "format": "binary", "description": "the file of a picture"}
    fields["depth"] = {"type": "string", "format": "binary", "description": "the file of a 16-bit PNG"}
    fields["camera"] = {"type": "string", "description": 'JSON: {"fx": 600, "fy": 600, "cx": 319.5, "cy": 239.5}'}
    fields["part"].update(fields["part"].pop("anyOf")[0])
    del fields["part"]["default"]
    form = {**sample, "properties": fields, "title": "SampleForm"}
    event = {
        "type": "object",
        "description": "One server-sent event; `data` is JSON on one line.",
        "required": ["event", "data"],
        "properties": {
            "event": {"enum": ["queued", "imagination", "target", "detection", "affordance", "error"]},
            "data": {"type": "string"},
        },
    }
    content = {
        "application/json": {"schema": sample, "examples": {"mug": {"value": example()}}},
        "multipart/form-data": {"schema": form},
    }
    return {
        "requestBody": {"required": True, "content": content},
        "responses": {"200": {"content": {"text/event-stream": {"schema": event}}}},
    }


def batch_extra() -> dict[str, Any]:
    """An example of a batch."""
    value = {"samples": [{**example(), "id": "left"}, {**example(), "id": "right"}]}
    return {"requestBody": {"content": {"application/json": {"examples": {"two": {"value": value}}}}}}


@lru_cache(maxsize=1)
def example() -> dict[str, str]:
    """A request that works: a small picture of a mug, and what to do with it."""
    picture = Image.new("RGB", (64, 48), "white")
    draw = ImageDraw.Draw(picture)
    draw.rectangle((14, 10, 38, 40), fill=(200, 60, 40))
    draw.arc((32, 15, 52, 35), -90, 90, fill=(200, 60, 40), width=4)
    data = encoded(picture, "PNG", optimize=True)
    return {"image": base64.b64encode(data).decode("ascii"), "instruction": "drink from the mug"}


def html_docs(schema: dict[str, Any]) -> str:
    """The schema as a page for people; it needs neither scripts nor another host."""
    curl = "curl -F image=@mug.jpg -F instruction='drink from the mug' http://127.0.0.1:8000/v1/affordances"
    if "securitySchemes" in schema["components"]:
        curl = curl.replace("curl ", "curl -H 'Authorization: Bearer TOKEN' ")
    operations = "".join(
        _operation(method.upper(), path, operation)
        for path, methods in schema["paths"].items()
        for method, operation in methods.items()
    )
    forms = "".join(
        f'<h3 id="{name}">{name}</h3><pre>{html.escape(json.dumps(form, indent=1, ensure_ascii=False))}</pre>'
        for name, form in schema["components"]["schemas"].items()
        if "ValidationError" not in name
    )
    about = "".join(f"<p>{html.escape(text)}</p>" for text in schema["info"]["description"].split("\n\n"))
    return (
        f"{_HEAD}<title>a4agent: HTTP API</title><h1>a4agent {html.escape(schema['info']['version'])}</h1>{about}"
        f"<pre>{html.escape(curl)}</pre>{operations}<h2>Forms</h2>{forms}"
    )


def _operation(method: str, path: str, operation: dict[str, Any]) -> str:
    parameters = "".join(
        f"<tr><td><code>?{parameter['name']}=</code><td>{_values(parameter['schema'])}"
        f"<td>{html.escape(parameter.get('description', ''))}"
        for parameter in operation.get("parameters", ())
    )
    answers = "".join(
        f"<tr><td>{code}<td>{html.escape(answer['description'])}" for code, answer in operation["responses"].items()
    )
    return (
        f"<h2><code>{method} {html.escape(path)}</code></h2><p>{html.escape(operation.get('description', ''))}</p>"
        + (f"<table>{parameters}</table>" if parameters else "")
        + f"<table>{answers}</table>"
    )


def _values(schema: dict[str, Any]) -> str:
    values = [str(value) for value in schema.get("enum", ("true", "false"))]
    return html.escape(f"{', '.join(values)}; default {str(schema.get('default')).lower()}")
