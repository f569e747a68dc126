"""A real HTTP server on the loopback that speaks the OpenAI protocol, counts, records and misbehaves on request.

server.replies(chat("hello"))                       every call is answered so
server.replies(status(429, retry_after="0.01"), chat("hello"))   one after the other; the last one stays
server.calls[0].json["messages"]                    what was asked
"""

from __future__ import annotations

import base64
import io
import json
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from PIL import Image


@dataclass(frozen=True)
class Reply:
    """One answer. `cut` sends half of the body and breaks the connection; `delay` waits first, in seconds."""

    body: bytes = b""
    status: int = 200
    headers: Mapping[str, str] = field(default_factory=dict)
    delay: float = 0.0
    cut: bool = False


@dataclass(frozen=True)
class Call:
    """One request as it arrived."""

    method: str
    path: str
    headers: Mapping[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


Script = Reply | Callable[[Call], Reply]


def as_json(value: Any, code: int = 200, **headers: str) -> Reply:
    """A JSON body."""
    named = {name.replace("_", "-"): text for name, text in headers.items()}
    return Reply(json.dumps(value).encode(), code, {"content-type": "application/json", **named})


def chat(
    text: str | None = "hello",
    *,
    finish_reason: str = "stop",
    refusal: str | None = None,
    usage: tuple[int, int, int] | None = (1000, 100, 0),
    choices: list[Any] | None = None,
    token_ids: list[int] | None = None,
    request_id: str = "req-1",
    **message: Any,
) -> Reply:
    """A chat completion; `usage` is (input, output, of the input cached) tokens."""
    choice: dict[str, Any] = {
        "index": 0,
        "finish_reason": finish_reason,
        "message": {"role": "assistant", "content": text, "refusal": refusal, **message},
    }
    if token_ids is not None:
        choice["token_ids"] = token_ids
    body: dict[str, Any] = {
        "id": "chatcmpl-1",
        "object": "chat.completion",
        "created": 1,
        "model": "m",
        "choices": [choice] if choices is None else choices,
    }
    if usage is not None:
        tokens_in, tokens_out, cached = usage
        body["usage"] = {
            "prompt_tokens": tokens_in,
            "completion_tokens": tokens_out,
            "total_tokens": tokens_in + tokens_out,
            "prompt_tokens_details": {"cached_tokens": cached},
        }
    return as_json(body, x_request_id=request_id)


def edited(image: Image.Image, usage: Mapping[str, Any] | None = None) -> Reply:
    """An answer of /v1/images/edits."""
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    data = [{"b64_json": base64.b64encode(buffer.getvalue()).decode()}]
    return as_json({"created": 1, "data": data, "usage": usage}, x_request_id="req-2")


def models(*names: str) -> Reply:
    """An answer of /v1/models."""
    return as_json({"object": "list", "data": [{"id": name, "object": "model", "created": 1} for name in names]})


def error(code: int, message: str, *, kind: str = "", **headers: str) -> Reply:
    """An error in OpenAI's form; `kind` is its code."""
    return as_json({"error": {"message": message, "code": kind or None, "type": kind or None}}, code, **headers)


class FaultyServer:
    """Serves until closed. `url` ends in /v1; `calls` lists what arrived, `busiest` how many at once."""

    def __init__(self) -> None:
        self.calls: list[Call] = []
        self.busiest = 0
        self._script: list[Script] = [chat()]
        self._models = models("m")
        self._busy = 0
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        handler = type("Handler", (_Handler,), {"owner": self})
        self._http = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        self._http.daemon_threads = True
        self._thread = threading.Thread(target=self._http.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._http.server_port}/v1"

    def replies(self, *script: Script, models: Reply | None = None) -> None:
        """Answer POSTs with these in turn, the last one again and again; GET /v1/models with `models`."""
        self._script = list(script)
        self._models = models or self._models

    def asked(self, path: str = "/v1/chat/completions") -> list[Call]:
        """The calls of one path, in order of arrival."""
        return [call for call in self.calls if call.path == path]

    def close(self) -> None:
        self._stopping.set()
        self._http.shutdown()
        self._http.server_close()

    def answer(self, call: Call) -> Reply:
        with self._lock:
            self.calls.append(call)
            if call.method == "GET":
                return self._models
            script = self._script.pop(0) if len(self._script) > 1 else self._script[0]
            self._busy += 1
            self.busiest = max(self.busiest, self._busy)
        try:
            reply = script(call) if callable(script) else script
            self._stopping.wait(reply.delay)
            return reply
        finally:
            with self._lock:
                self._busy -= 1


class _Handler(BaseHTTPRequestHandler):
    owner: FaultyServer
    protocol_version = "HTTP/1.1"

    def do_POST(self) -> None:
        self._serve()

    def do_GET(self) -> None:
        self._serve()

    def _serve(self) -> None:
        body = self.rfile.read(int(self.headers.get("content-length") or 0))
        headers = {name.lower(): value for name, value in self.headers.items()}
        reply = self.owner.answer(Call(self.command, self.path, headers, body))
        try:
            self.send_response(reply.status)
            for name, value in {"content-length": str(len(reply.body)), **reply.headers}.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(reply.body[: len(reply.body) // 2] if reply.cut else reply.body)
            self.wfile.flush()
        except OSError:
            self.close_connection = True  # the client gave up waiting
        if reply.cut:
            time.sleep(0.01)
            self.close_connection = True

    def log_message(self, *_: Any) -> None:
        """Keep the test's output clean."""
