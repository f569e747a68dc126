"""Runs the HTTP application until a signal; what is in flight is finished first."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

import uvicorn

from a4agent.errors import ConfigError


def bind(host: str, port: int) -> socket.socket:
    """A listening socket; port 0 takes a free one.

    Raises:
        ConfigError: the port is taken, or the host is not one of this machine's.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host.strip("[]"), port), family=family, backlog=2048)
    except (OSError, OverflowError) as error:
        raise ConfigError(f"cannot listen on {host}:{port}: {error}; choose another --port or --host") from error


def url_of(listening: socket.socket) -> str:
    """Where the server can be called."""
    host, port = listening.getsockname()[:2]
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def run(app: Any, listening: socket.socket, *, seconds: float) -> None:
    """Serve `app` on a socket until SIGINT or SIGTERM.

    Then no connection is taken any more, requests in flight have up to `seconds` to be answered, and the
    application's own end (its agents are closed) is waited for.
    """
    _server(app, seconds).run(sockets=[listening])


@contextmanager
def in_thread(app: Any, *, seconds: float = 30.0) -> Generator[str]:
    """Serve `app` on a free port of loopback while the block runs; gives its URL. For notebooks and tests."""
    listening = bind("127.0.0.1", 0)
    server = _server(app, seconds)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, name="a4-serve", daemon=True)
    thread.start()
    try:
        while not server.started and thread.is_alive():
            time.sleep(0.005)
        yield url_of(listening)
    finally:
        server.should_exit = True
        thread.join()


def _server(app: Any, seconds: float) -> uvicorn.Server:
    config = uvicorn.Config(
        app,
        log_level="warning",
        access_log=False,
        server_header=False,
        timeout_keep_alive=30,
        timeout_graceful_shutdown=int(seconds) + 1,
    )
    return uvicorn.Server(config)
