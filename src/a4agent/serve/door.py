"""What every request passes before anything of it is read: token, a free place, size, and an upload that ends."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

from starlette.datastructures import Headers
from starlette.responses import JSONResponse

from a4agent.serve import auth
from a4agent.serve.limits import Limits, Refused
from a4agent.serve.metrics import Metrics
from a4agent.serve.workers import Workers

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

DRAIN_FACTOR = 4
DRAIN_SECONDS = 5.0
"""A refused upload is read and thrown away up to this many limits and seconds, so that a caller who sends first and
reads then gets the answer and no broken connection."""


class Door:
    """ASGI middleware. A `POST` holds one of `queue + workers` places from before its body is read until its answer."""

    def __init__(self, app: App, *, limits: Limits, token: str | None, workers: Workers, metrics: Metrics) -> None:
        self.app = app
        self.limits = limits
        self.token = token
        self.workers = workers
        self.metrics = metrics
        self.places = limits.queue + workers.count

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        body = _Body(receive, self.limits)

        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                self.metrics.answered(scope["method"], scope["path"], message["status"])
                if scope["method"] == "POST":
                    await body.drain()
            await send(message)

        try:
            headers = Headers(scope=scope)
            auth.check(self.token, scope["path"], headers)
            if scope["method"] != "POST":
                await self.app(scope, receive, answer)
                return
            body.expect(headers.get("content-length"))
            self._enter()
        except Refused as refused:
            await refuse(refused)(scope, receive, answer)
            return
        try:
            await self.app(scope, body.receive, answer)
        except Exception:  # answered further out, with a 500
            self.metrics.answered(scope["method"], scope["path"], 500)
            raise
        finally:
            self.places += 1

    def _enter(self) -> None:
        if self.places <= 0:
            raise Refused(503, "the queue is full; try again later", self.workers.seconds_to_wait())
        self.places -= 1


def refuse(refused: Refused) -> JSONResponse:
    """The HTTP answer to a refused request."""
    headers = refused.headers
    if refused.code == 401:
        headers["WWW-Authenticate"] = "Bearer"
    return JSONResponse(refused.body, refused.code, headers)


class _Body:
    """The body of a request, counted and timed as it arrives."""

    def __init__(self, receive: Receive, limits: Limits) -> None:
        self._receive = receive
        self._limits = limits
        self._bytes = 0
        self._complete = False
        self._deadline: float | None = None

    def expect(self, content_length: str | None) -> None:
        """Refuse what already says that it is too long."""
        if content_length is not None and content_length.isdigit() and int(content_length) > self._limits.body_bytes:
            raise self._too_long(int(content_length))

    async def receive(self) -> Message:
        if self._complete:
            return await self._receive()
        loop = asyncio.get_running_loop()
        self._deadline = self._deadline or loop.time() + self._limits.upload_seconds
        try:
            message = await asyncio.wait_for(self._receive(), self._deadline - loop.time())
        except asyncio.TimeoutError:
            raise Refused(408, f"the upload took longer than {self._limits.upload_seconds:g} seconds") from None
        self._note(message)
        if self._bytes > self._limits.body_bytes:
            raise self._too_long(self._bytes)
        return message

    async def drain(self) -> None:
        """Read the rest and throw it away, within reason."""
        most = DRAIN_FACTOR * self._limits.body_bytes

        async def rest() -> None:
            while not self._complete and self._bytes <= most:
                self._note(await self._receive())

        try:
            await asyncio.wait_for(rest(), min(DRAIN_SECONDS, self._limits.upload_seconds))
        except asyncio.TimeoutError:
            return

    def _note(self, message: Message) -> None:
        self._bytes += len(message.get("body", b""))
        self._complete = message["type"] != "http.request" or not message.get("more_body", False)

    def _too_long(self, length: int) -> Refused:
        return Refused(413, f"the request has {length} bytes or more, over the limit of {self._limits.body_bytes}")
