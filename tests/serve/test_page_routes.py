from __future__ import annotations

import asyncio
import re
from collections.abc import Iterator
from typing import Any

import pytest
from starlette.requests import Request
from starlette.responses import PlainTextResponse
from starlette.types import Message, Receive, Scope, Send

from a4agent.config import load_settings
from a4agent.serve.admission import Refused
from a4agent.serve.page_routes import MAX_CALL_BYTES, SENT, RouteCheck

USED = {
    *("GET /", "GET /config", "GET /theme.css", "GET /favicon.ico", "GET /assets/x", "GET /static/x", "POST /login"),
    *("GET /gradio_api/queue/data", "GET /gradio_api/upload_progress", "GET /gradio_api/file=x"),
    *("POST /gradio_api/queue/join", "POST /gradio_api/run/predict", "POST /gradio_api/upload"),
}


def scope(method: str, path: str, headers: dict[str, str] | None = None) -> Scope:
    given = {"host": "localhost", **(headers or {})}
    raw = [(name.encode(), value.encode()) for name, value in given.items()]
    return {"type": "http", "method": method, "path": path, "headers": raw}


def routes_of(app: Any) -> Iterator[str]:
    """("GET /config", ...) of an application and all that it includes, each placeholder an x."""
    for route in app.routes:
        for below in (getattr(route, "app", None), getattr(route, "original_router", None)):
            if hasattr(below, "routes"):
                yield from routes_of(below)
        for method in getattr(route, "methods", None) or ():
            yield f"{method} {re.sub('{.*?}', 'x', route.path.replace('{api_name}', 'predict'))}"


async def no_app(scope: Scope, receive: Receive, send: Send) -> None:
    raise AssertionError("not reached")


def refusal(method: str, path: str, password: bool = False, headers: dict[str, str] | None = None) -> int | None:
    try:
        RouteCheck(no_app, password).check(scope(method, path, headers))
    except Refused as refused:
        return refused.code
    return None


@pytest.mark.parametrize("password", [False, True])
def test_of_gradios_routes_only_those_that_the_page_uses_are_answered(password: bool) -> None:
    pytest.importorskip("gradio", reason="needs the extra app")
    from a4agent.serve.page import create_page

    async def inside_a_loop() -> Any:
        return create_page(load_settings, check=lambda settings: [])

    found = set(routes_of(asyncio.run(inside_a_loop())))
    assert len(found) > 50
    assert found >= USED
    answered = {route for route in found if refusal(*route.split(), password=password) is None}
    assert {route for route in answered if not route.startswith("HEAD")} == USED
    assert refusal("POST", "/gradio_api/process_recording", password) == 404
    assert refusal("GET", "/gradio_api/file=https://example.org/a.png", password) == 403
    assert refusal("DELETE", "/", password) == 404


def call(chunks: list[bytes], path: str = "/login") -> tuple[list[int], int]:
    """The codes of the answers, and how many bytes the application read."""
    codes: list[int] = []
    held: list[bytes] = []
    waiting = list(chunks)

    async def receive() -> Message:
        return {"type": "http.request", "body": waiting.pop(0), "more_body": bool(waiting)}

    async def send(message: Message) -> None:
        if message["type"] == "http.response.start":
            codes.append(message["status"])

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        async for chunk in Request(scope, receive).stream():
            held.append(chunk)
        await PlainTextResponse("fine")(scope, receive, send)

    asyncio.run(RouteCheck(app, password=True)(scope("POST", path), receive, send))
    return codes, sum(map(len, held))


def test_no_body_is_read_beyond_its_limit() -> None:
    most = MAX_CALL_BYTES
    for path, bytes_of_path in SENT.items():
        assert refusal("POST", path, headers={"content-length": str(bytes_of_path + 1)}) == 413
        assert refusal("POST", path, headers={"content-length": str(bytes_of_path)}) is None
    assert call([bytes(most)]) == ([200], most)
    assert call([bytes(most), b"x"]) == ([413], most)
    assert call([bytes(2**16)] * 1000) == ([413], most)
    assert call([bytes(2**16)] * 20, "/gradio_api/upload") == ([200], 20 * 2**16)
