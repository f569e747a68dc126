"""What a request passes before it is read: the token, its size and time, and a place in the queue.

On loopback anyone at this machine may call, beyond it only who holds the token.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import ipaddress
import json
import logging
import os
import stat
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

from starlette.datastructures import Headers
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from a4agent.errors import ConfigError, InputError
from a4agent.redaction import redact
from a4agent.serve.workers import Counters, Workers

access = logging.getLogger("a4agent.serve.access")

VARIABLE = "A4_SERVER_TOKEN"
SHORTEST = 16
MAKE_TOKEN = "python -c 'import secrets; print(secrets.token_urlsafe())'"
OPEN_PATHS = frozenset({"/", "/docs", "/healthz", "/readyz", "/openapi.json"})
"""Readable without a token: they contain nothing of any request."""
STREAM_TYPE = "text/event-stream; charset=utf-8"
DRAIN_FACTOR = 4
DRAIN_SECONDS = 5.0
"""A refused upload is read and thrown away up to this many limits and seconds: a caller who sends everything before
reading then gets the answer instead of a broken connection."""


def is_loopback(host: str) -> bool:
    """Whether a host name or address can only be reached from this machine."""
    name = host.strip("[]").lower()
    if name == "localhost":
        return True
    try:
        return ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False


def read_token(host: str, token_file: Path | None = None, environ: Mapping[str, str] | None = None) -> str | None:
    """The token from a file or from A4_SERVER_TOKEN; None only where `host` is loopback.

    Raises:
        ConfigError: no token for a host that others can reach, an unreadable file, or a token that is too short.
    """
    if token_file is not None:
        try:
            token = token_file.read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"the token file {str(token_file)!r} cannot be read: {error}") from error
        source = repr(str(token_file))
    else:
        token = (os.environ if environ is None else environ).get(VARIABLE, "").strip()
        source = VARIABLE
    if not token:
        if token_file is not None:
            raise ConfigError(f"the token file {str(token_file)!r} is empty: {MAKE_TOKEN} > {str(token_file)!r}")
        if is_loopback(host):
            return None
        raise ConfigError(
            f"serving on {host!r} needs a token, because others can reach it: set {VARIABLE} or --token-file"
            f" ({MAKE_TOKEN} makes one), or serve on 127.0.0.1"
        )
    if len(token) < SHORTEST or not token.isascii() or not token.isprintable() or " " in token:
        raise ConfigError(f"the token in {source} must be {SHORTEST} or more printable ASCII characters without spaces")
    return token


def check_caller(
    token: str | None, path: str, headers: Mapping[str, str], open_paths: frozenset[str] = OPEN_PATHS
) -> None:
    """Check the token; without one, that the request was made on this machine.

    Without a token, the `Host` and `Origin` must be loopback too: a web page that the user of this machine has open
    must not be able to call the server through the browser.

    Raises:
        Refused: 401 no token or a wrong one, 403 from a foreign web page.
    """
    if path in open_paths:
        return
    if token is None:
        origin = headers.get("origin")
        from_elsewhere = origin is not None and not is_loopback(_host_of(origin))
        if not is_loopback(_host_of(f"//{headers.get('host', '')}")) or from_elsewhere:
            raise Refused(403, "this server answers only requests made to and from this machine")
        return
    kind, _, given = headers.get("authorization", "").partition(" ")
    if kind.lower() != "bearer":
        raise Refused(401, "this server needs a token: send the header 'Authorization: Bearer TOKEN'")
    if not hmac.compare_digest(given.strip().encode(), token.encode()):
        raise Refused(401, "the token is wrong: send the one that the server was started with")


def _host_of(url: str) -> str:
    """The host that a URL names; "" for an invalid URL."""
    try:
        return urlsplit(url).hostname or ""
    except ValueError:
        return ""


@dataclass(frozen=True)
class Limits:
    """How much requests may ask for.

    Worst-case memory is about `(queue + workers) * (2 * body_bytes + 3 * pixels)` bytes, with `batch_pixels` for
    `pixels` where callers send batches.

    Attributes:
        body_bytes: the most bytes of a request's body; more is a 413.
        pixels: the most pixels of a picture; more is a 413, told from its header before anything is decoded.
        queue: how many requests may wait besides those being worked on; the next one is a 503 with Retry-After.
        seconds: from the end of the upload to the answer; longer is a 503 with Retry-After.
        upload_seconds: how long a body may take to arrive; longer is a 408.
        batch: the most samples of a batch request; more is a 422.
    """

    body_bytes: int = 32 * 2**20
    pixels: int = 25_000_000
    queue: int = 16
    seconds: float = 300.0
    upload_seconds: float = 30.0
    batch: int = 16

    @property
    def batch_pixels(self) -> int:
        """The most pixels of a batch's pictures together; those beyond are refused one by one."""
        return 4 * self.pixels


class Refused(Exception):
    """A request that is answered with an HTTP error: status code, one sentence, and when to try again."""

    def __init__(self, code: int, message: str, retry_after: float | None = None) -> None:
        super().__init__(message)
        self.code = code
        self.message = redact(message)
        self.retry_after = retry_after

    @property
    def body(self) -> dict[str, Any]:
        """The JSON that every error has."""
        return {"error": self.message}

    def response(self) -> Response:
        """The HTTP answer; `Retry-After` is in whole seconds, at least one."""
        headers = {} if self.retry_after is None else {"Retry-After": str(max(1, round(self.retry_after)))}
        if self.code == 401:
            headers["WWW-Authenticate"] = "Bearer"
        return JsonResponse(self.body, self.code, headers)


class JsonResponse(JSONResponse):
    """Compact JSON. Half a surrogate in a model's text, which UTF-8 cannot hold, becomes U+FFFD."""

    def render(self, content: Any) -> bytes:
        return to_json(content)


def to_json(data: Any) -> bytes:
    """Compact JSON on one line as UTF-8.

    Raises:
        ValueError: a number that JSON cannot hold, NaN or infinity.
    """
    text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    try:
        return text.encode()
    except UnicodeEncodeError:
        return text.encode("utf-16", "surrogatepass").decode("utf-16", "replace").encode()


def read_below(path: str, folders: Sequence[Path], max_bytes: int) -> bytes:
    """The bytes of a regular file below one of the folders, opened without following a link or waiting for a pipe.

    Raises:
        InputError: the resolved path leads elsewhere, is not a regular file, or has more than `max_bytes`.
    """
    try:
        real = Path(os.path.realpath(path))
        if not any(real.is_relative_to(os.path.realpath(folder)) for folder in folders):
            raise InputError("the file is outside the allowed folders")
        descriptor = os.open(real, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
    except (OSError, ValueError) as error:
        raise InputError(f"the file cannot be opened: {getattr(error, 'strerror', None) or error}") from error
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise InputError("not a regular file")
        if status.st_size > max_bytes:
            raise InputError(f"the file is larger than {max_bytes // 2**20} MB")
        with open(descriptor, "rb", closefd=False) as file:
            return file.read(max_bytes)
    finally:
        os.close(descriptor)


class CallerCheck:
    """ASGI middleware for applications without `Admission`: `check_caller`, and headers added to each answer."""

    def __init__(self, app: ASGIApp, token: str | None, headers: Mapping[str, str] | None = None) -> None:
        self.app = app
        self.token = token
        self.headers = [(name.lower().encode(), value.encode()) for name, value in (headers or {}).items()]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *self.headers]
            await send(message)

        if scope["type"] == "http":
            try:
                self.check(scope)
            except Refused as refused:
                await refused.response()(scope, receive, answer)
                return
        await self.app(scope, receive, answer)

    def check(self, scope: Scope) -> None:
        """Raises Refused for a caller who may not call."""
        check_caller(self.token, scope["path"], Headers(scope=scope), open_paths=frozenset())


class Place:
    """One of the `queue + workers` places of a server."""

    def __init__(self, free: Callable[[], None]) -> None:
        self._free: Callable[[], None] | None = free

    def release(self) -> None:
        """Give the place back; the second time does nothing."""
        free, self._free = self._free, None
        if free is not None:
            free()


class Admission:
    """ASGI middleware: token, size and time of the upload, and one of `queue + workers` places.

    A `POST` takes its place when its body is whole and gives it back when its answer is ready, so that slow senders
    and readers hold up nobody else. Uploads in progress share the bytes of as many full bodies as there are places.
    """

    def __init__(
        self, app: ASGIApp, *, limits: Limits, token: str | None, workers: Workers, counters: Counters
    ) -> None:
        self.app = app
        self.limits = limits
        self.token = token
        self.workers = workers
        self.counters = counters
        self.places = limits.queue + workers.count
        self.upload_bytes = self.places * limits.body_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        started, code = time.monotonic(), 500
        post = scope["method"] == "POST"
        upload = _Upload(receive, self)
        place: Place | None = None

        async def answer(message: Message) -> None:
            nonlocal code
            if message["type"] == "http.response.start":
                code = message["status"]
                if post:
                    await upload.drain()
                if place and (b"content-type", STREAM_TYPE.encode()) not in message["headers"]:
                    place.release()
            await send(message)

        try:
            headers = Headers(scope=scope)
            check_caller(self.token, scope["path"], headers)
            if post:
                receive = await upload.read(headers.get("content-length"))
                scope["place"] = place = self._enter()
            await self.app(scope, receive, answer)
        except Refused as refused:
            await refused.response()(scope, receive, answer)
        finally:
            upload.free()
            if place:
                place.release()
            self.counters.answered(scope["method"], scope["path"], code)
            access.info("%s", _access_line(scope, code, time.monotonic() - started))

    def _enter(self) -> Place:
        if self.places <= 0:
            raise Refused(503, "the queue is full; try again later", self.workers.seconds_to_wait())
        self.places -= 1
        return Place(self._leave)

    def _leave(self) -> None:
        self.places += 1


class _Upload:
    """The body of a request, counted and timed as it arrives."""

    def __init__(self, receive: Receive, admission: Admission) -> None:
        self._receive = receive
        self._admission = admission
        self._limits = admission.limits
        self._read = 0
        self._held = 0
        self._complete = False

    async def read(self, content_length: str | None) -> Receive:
        """Read the whole body; returns a `receive` that gives it again, then what comes after it.

        Raises:
            Refused: 408 too slow, 413 too long, 503 other uploads hold too many bytes.
        """
        if content_length is not None and content_length.isdigit() and int(content_length) > self._limits.body_bytes:
            raise self._too_long(int(content_length))
        chunks: list[bytes] = []
        try:
            await asyncio.wait_for(self._collect(chunks), self._limits.upload_seconds)
        except asyncio.TimeoutError:
            raise Refused(408, f"the upload took longer than {self._limits.upload_seconds:g} seconds") from None
        whole: list[Message] = [{"type": "http.request", "body": b"".join(chunks), "more_body": False}]
        del chunks

        async def replay() -> Message:
            return whole.pop() if whole else await self._receive()

        return replay

    async def _collect(self, chunks: list[bytes]) -> None:
        while not self._complete:
            chunk = await self._next()
            if self._read > self._limits.body_bytes:
                raise self._too_long(self._read)
            if len(chunk) > self._admission.upload_bytes:
                raise Refused(503, "too many uploads at once; try again later", self._limits.upload_seconds)
            self._admission.upload_bytes -= len(chunk)
            self._held += len(chunk)
            chunks.append(chunk)

    async def drain(self) -> None:
        """Read the rest of a refused upload and throw it away, within reason."""
        most = DRAIN_FACTOR * self._limits.body_bytes

        async def rest() -> None:
            while not self._complete and self._read <= most:
                await self._next()

        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(rest(), min(DRAIN_SECONDS, self._limits.upload_seconds))

    def free(self) -> None:
        """Give back the bytes that this upload held."""
        self._admission.upload_bytes += self._held
        self._held = 0

    async def _next(self) -> bytes:
        message = await self._receive()
        chunk = message.get("body", b"")
        self._read += len(chunk)
        self._complete = message["type"] != "http.request" or not message.get("more_body", False)
        return chunk

    def _too_long(self, length: int) -> Refused:
        return Refused(413, f"the request has {length} bytes or more, over the limit of {self._limits.body_bytes}")


def _access_line(scope: Scope, code: int, seconds: float) -> str:
    """One line of the access log; the query is left out, and no byte of the path can end the line."""
    caller = (scope.get("client") or ("-",))[0]
    return f"{caller} {quote(scope['method'])} {quote(scope['path'])[:200]} {code} {seconds:.3f} s"
