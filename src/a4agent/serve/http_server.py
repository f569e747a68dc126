"""Serves an ASGI application on a socket until a signal, and protects it from slow and idle connections.

uvicorn waits without a limit for a request's headers and for a caller to read its answer, and accepts connections until
the process has no file handles left. `GuardedProtocol` adds the deadlines and the limits.
"""

from __future__ import annotations

import asyncio
import ctypes
import functools
import logging
import socket
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from a4agent.errors import ConfigError
from a4agent.serve.admission import is_loopback

BACKLOG = 128
MAX_LOG_RECORDS = 100
LOG_WINDOW_SECONDS = 10.0
LARGE_BUFFER = 128 * 1024
"""Buffers of at least this many bytes are returned to the system when they are freed; glibc's initial value."""
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of <malloc.h>


@dataclass(frozen=True)
class ConnectionLimits:
    """What connections may hold.

    Attributes:
        total: connections at a time. One more closes the connection that has waited longest without a whole request;
            if all have one, the new connection is closed.
        per_address: the same for one address. Loopback is exempt: a reverse proxy there forwards for all callers.
        header_seconds: from the first byte (or the connection) to the end of the headers.
        body_seconds: from there to the end of the body.
        idle_seconds: between two requests of a connection.
        write_seconds: how long a caller may read nothing of an answer that does not fit into the buffers.
    """

    total: int = 256
    per_address: int = 64
    header_seconds: float = 10.0
    body_seconds: float = 120.0
    idle_seconds: int = 30
    write_seconds: float = 30.0

    def within_file_handles(self) -> int:
        """`total`, or half of the process's file handles where that is less."""
        try:
            import resource
        except ImportError:  # Windows
            return self.total
        soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        return self.total if soft == resource.RLIM_INFINITY else max(1, min(self.total, soft // 2))


def bind(host: str, port: int) -> socket.socket:
    """A listening socket; port 0 takes a free one.

    Raises:
        ConfigError: the port is taken, or the host is not one of this machine's.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host.strip("[]"), port), family=family, backlog=BACKLOG)
    except (OSError, OverflowError) as error:
        raise ConfigError(f"cannot listen on {host}:{port}: {error}; choose another --port or --host") from error


def url_of(listening: socket.socket) -> str:
    """The server's URL."""
    host, port = listening.getsockname()[:2]
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def run(app: Any, listening: socket.socket, *, seconds: float, limits: ConnectionLimits | None = None) -> None:
    """Serve `app` on a socket until SIGINT or SIGTERM.

    Then the server takes no more connections, gives requests in flight up to `seconds` to finish, and waits for the
    application's shutdown.
    """
    _server(app, seconds, limits).run(sockets=[listening])


def return_freed_memory() -> None:
    """Let the C library give the memory of large buffers back to the system as soon as they are freed.

    glibc stops doing so for sizes that it has seen freed, and the memory of a server of pictures then depends on their
    order. Other C libraries are not changed.
    """
    try:
        set_option = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # musl, macOS, Windows
        return
    for option in (_MMAP_THRESHOLD, _TRIM_THRESHOLD):
        set_option(option, LARGE_BUFFER)


@contextmanager
def in_thread(app: Any, *, seconds: float = 30.0, limits: ConnectionLimits | None = None) -> Generator[str]:
    """Serve `app` on a free port of loopback while the block runs; gives its URL. For notebooks and tests."""
    listening = bind("127.0.0.1", 0)
    server = _server(app, seconds, limits)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, name="a4-serve", daemon=True)
    thread.start()
    try:
        while not server.started and thread.is_alive():
            time.sleep(0.005)
        yield url_of(listening)
    finally:
        server.should_exit = True
        thread.join()


def _server(app: Any, seconds: float, limits: ConnectionLimits | None) -> uvicorn.Server:
    return_freed_memory()
    limits = limits or ConnectionLimits()
    protocol: Any = functools.partial(GuardedProtocol, connections=Connections(limits))
    config = uvicorn.Config(
        app,
        http=protocol,
        ws="none",
        backlog=BACKLOG,
        log_level="warning",
        access_log=False,
        server_header=False,
        timeout_keep_alive=limits.idle_seconds,
        timeout_graceful_shutdown=int(seconds) + 1,
    )
    for name in ("asyncio", "uvicorn.error"):
        logger = logging.getLogger(name)
        if not any(isinstance(known, LogRateLimit) for known in logger.filters):
            logger.addFilter(LogRateLimit())
    return uvicorn.Server(config)


Phase = Literal["headers", "body", "answer", "idle"]


class Connections:
    """The open connections of a server, those that have waited longest first."""

    def __init__(self, limits: ConnectionLimits) -> None:
        self.limits = limits
        self.total = limits.within_file_handles()
        self._open: dict[GuardedProtocol, None] = {}

    def admit(self, connection: GuardedProtocol) -> None:
        """Add a connection, closing one that is waiting if there are too many."""
        self._open[connection] = None
        address = connection.address
        same = [other for other in self._open if other.address == address] if not is_loopback(address) else []
        if len(same) > self.limits.per_address:
            self._close_one(same)
        elif len(self._open) > self.total:
            self._close_one(list(self._open))

    def renew(self, connection: GuardedProtocol) -> None:
        """Move a connection that made progress behind the others."""
        if connection in self._open:
            del self._open[connection]
            self._open[connection] = None

    def remove(self, connection: GuardedProtocol) -> None:
        """Forget a connection."""
        self._open.pop(connection, None)

    def _close_one(self, candidates: list[GuardedProtocol]) -> None:
        longest = next((other for other in candidates if other.phase != "answer"), candidates[-1])
        self.remove(longest)
        longest.abort()


class GuardedProtocol(H11Protocol):
    """uvicorn's HTTP/1.1 with deadlines for headers, bodies and unread answers, and limits on connections."""

    def __init__(self, *arguments: Any, connections: Connections, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self.guard = connections
        self.phase: Phase = "headers"
        self._deadline: asyncio.TimerHandle | None = None
        self._write_deadline: asyncio.TimerHandle | None = None

    @property
    def address(self) -> str:
        """The caller's address."""
        return self.client[0] if self.client else ""

    def abort(self) -> None:
        """Close at once, whatever is still to be sent."""
        self.transport.abort()

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._enter("headers")
        self.guard.admit(self)

    def connection_lost(self, exc: Exception | None) -> None:
        self.guard.remove(self)
        for timer in (self._deadline, self._write_deadline):
            if timer is not None:
                timer.cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._follow(receiving=True)

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._follow(receiving=False)
        if self.transport.get_write_buffer_size():
            self._await_reader()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._await_reader()

    def resume_writing(self) -> None:
        super().resume_writing()
        if self._write_deadline is not None:
            self._write_deadline.cancel()
            self._write_deadline = None

    def _follow(self, receiving: bool) -> None:
        """Enter the phase that the connection is in now."""
        answered = self.cycle is None or self.cycle.response_complete  # pyright: ignore[reportUnnecessaryComparison]
        if answered:
            phase: Phase = "headers" if receiving else "idle"
        else:
            phase = "body" if self.cycle.more_body else "answer"
        if phase != self.phase:
            self._enter(phase)

    def _enter(self, phase: Phase) -> None:
        self.phase = phase
        self.guard.renew(self)
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None
        limits = self.guard.limits
        seconds = {"headers": limits.header_seconds, "body": limits.body_seconds}.get(phase)
        if seconds is not None:  # uvicorn itself closes idle connections
            self._deadline = self.loop.call_later(seconds, self.abort)

    def _await_reader(self) -> None:
        if self._write_deadline is None:
            self._write_deadline = self.loop.call_later(self.guard.limits.write_seconds, self._close_unread)

    def _close_unread(self) -> None:
        self._write_deadline = None
        if self.transport.get_write_buffer_size():
            self.abort()


class LogRateLimit(logging.Filter):
    """Lets MAX_LOG_RECORDS records of a logger through in LOG_WINDOW_SECONDS, and counts the rest."""

    def __init__(self) -> None:
        super().__init__()
        self._since = -LOG_WINDOW_SECONDS
        self._seen = 0

    def filter(self, record: logging.LogRecord) -> bool:
        now = time.monotonic()
        if now - self._since >= LOG_WINDOW_SECONDS:
            left_out = self._seen - MAX_LOG_RECORDS
            self._since, self._seen = now, 0
            if left_out > 0:
                record.msg, record.args = f"{record.getMessage()} ({left_out} more messages before this one)", None
        self._seen += 1
        return self._seen <= MAX_LOG_RECORDS
