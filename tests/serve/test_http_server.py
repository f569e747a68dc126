from __future__ import annotations

import asyncio
import contextlib
import http.client
import logging
import platform
import socket
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any

import pytest
from starlette.applications import Starlette
from starlette.responses import PlainTextResponse, StreamingResponse
from starlette.routing import Route

from a4agent.agent import A4Agent
from a4agent.client import Client
from a4agent.errors import ConfigError
from a4agent.serve import http_server
from a4agent.serve.admission import Limits
from a4agent.serve.api import create_app
from a4agent.serve.http_server import ConnectionLimits, Connections
from a4agent.testing import scripted_agent


def test_a_free_port_is_found_and_named() -> None:
    with http_server.bind("127.0.0.1", 0) as listening:
        port = listening.getsockname()[1]
        assert http_server.url_of(listening) == f"http://127.0.0.1:{port}"
        with pytest.raises(ConfigError, match=f"127.0.0.1:{port}.*choose another --port"):
            http_server.bind("127.0.0.1", port)


def test_addresses_of_both_kinds() -> None:
    try:
        listening = http_server.bind("::1", 0)
    except ConfigError:
        pytest.skip("this machine has no IPv6")
    with listening:
        assert http_server.url_of(listening).startswith("http://[::1]:")


def test_a_host_that_is_not_ours_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"192\.0\.2\.1"):
        http_server.bind("192.0.2.1", 0)


def test_a_server_in_a_thread_ends_with_its_block() -> None:
    async def hello(request: object) -> PlainTextResponse:
        return PlainTextResponse("hello")

    with http_server.in_thread(Starlette(routes=[Route("/", hello)])) as url:
        connection = http.client.HTTPConnection(url.removeprefix("http://"))
        connection.request("GET", "/")
        answer = connection.getresponse()
        assert answer.read() == b"hello"
        assert answer.getheader("server") is None
        connection.close()
    assert not any(thread.name == "a4-serve" for thread in threading.enumerate())


HALF = b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow: "


def connect(url: str) -> socket.socket:
    host, port = url.removeprefix("http://").split(":")
    return socket.create_connection((host, int(port)), timeout=10)


def is_closed(connection: socket.socket) -> bool:
    try:
        return connection.recv(1) == b""
    except ConnectionResetError:
        return True


def health(url: str) -> int:
    connection = http.client.HTTPConnection(url.removeprefix("http://"), timeout=5)
    try:
        connection.request("GET", "/healthz")
        return connection.getresponse().status
    finally:
        connection.close()


@pytest.fixture
def guarded() -> Iterator[Callable[..., str]]:
    """guarded(total=4, ...) -> the URL of an API with these connection limits."""
    with contextlib.ExitStack() as stack:

        def start(queue: int = 2, agent: A4Agent | None = None, **limits: Any) -> str:
            app = create_app([agent or scripted_agent()], limits=Limits(queue=queue, seconds=10))
            return stack.enter_context(http_server.in_thread(app, limits=ConnectionLimits(**limits)))

        yield start


def test_half_sent_headers_never_keep_others_out(guarded: Callable[..., str]) -> None:
    url = guarded(total=8)
    with contextlib.ExitStack() as stack:
        slow = [stack.enter_context(connect(url)) for _ in range(40)]
        for connection in slow:
            with contextlib.suppress(OSError):
                connection.sendall(HALF)
        assert [health(url) for _ in range(5)] == [200] * 5
        assert is_closed(slow[0])
        slow[-1].settimeout(0.2)
        with pytest.raises(TimeoutError):
            slow[-1].recv(1)


def test_headers_and_bodies_have_deadlines(guarded: Callable[..., str]) -> None:
    url = guarded(header_seconds=0.3, body_seconds=0.3, idle_seconds=1)
    body = b"POST /v1/affordances HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 100\r\n\r\nx"
    whole = b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    for sent in (b"", HALF, body, whole + HALF):
        with connect(url) as connection:
            connection.sendall(sent)
            began = time.monotonic()
            while connection.recv(4096):
                pass
            assert time.monotonic() - began < 3
    assert health(url) == 200


def test_an_answer_that_nobody_reads_is_cut_off() -> None:
    sent: list[int] = []

    async def endless(request: object) -> StreamingResponse:
        async def parts() -> AsyncIterator[bytes]:
            try:
                while True:
                    yield bytes(2**16)
                    await asyncio.sleep(0)
            finally:
                sent.append(1)

        return StreamingResponse(parts())

    limits = ConnectionLimits(write_seconds=0.3)
    app = Starlette(routes=[Route("/", endless)])
    with http_server.in_thread(app, limits=limits) as url, connect(url) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        deadline = time.monotonic() + 10
        while not sent and time.monotonic() < deadline:
            time.sleep(0.05)
        assert sent


def test_slow_uploads_hold_no_place(guarded: Callable[..., str], photo: bytes) -> None:
    url = guarded(queue=2)
    head = b"POST /v1/affordances HTTP/1.1\r\nHost: 127.0.0.1\r\n"
    head += b"Content-Type: application/json\r\nContent-Length: 9999\r\n\r\n{"
    with contextlib.ExitStack() as stack:
        for _ in range(17):
            stack.enter_context(connect(url)).sendall(head)
        time.sleep(0.1)
        assert Client(url, retries=0).predict(photo, "open the drawer").status == "ok"


def test_one_address_cannot_take_all_connections(monkeypatch: pytest.MonkeyPatch) -> None:
    class Fake:
        def __init__(self, address: str, phase: str = "headers") -> None:
            self.address, self.phase, self.closed = address, phase, False

        def abort(self) -> None:
            self.closed = True

    guard = Connections(ConnectionLimits(total=6, per_address=2))
    stranger, robot, local = "192.0.2.1", "192.0.2.2", "127.0.0.1"
    many = [Fake(stranger), Fake(stranger, "answer"), Fake(stranger, "answer"), Fake(stranger, "answer")]
    others = [Fake(robot), *(Fake(local) for _ in range(3))]
    for connection in (*many, *others):
        guard.admit(connection)  # type: ignore[arg-type]
    assert [connection.closed for connection in many] == [True, False, False, True]
    assert not any(connection.closed for connection in others)
    guard.admit(Fake(local))  # type: ignore[arg-type]
    assert [connection.closed for connection in others] == [True, False, False, False]


def test_a_flood_of_log_records_is_cut_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(http_server.time, "monotonic", lambda: clock[0])
    limit = http_server.LogRateLimit()
    record = logging.LogRecord("asyncio", logging.ERROR, "", 0, "out of %s", ("files",), None)
    assert sum(limit.filter(record) for _ in range(5000)) == http_server.MAX_LOG_RECORDS
    clock[0] = 60.0
    assert limit.filter(record)
    assert record.getMessage() == "out of files (4900 more messages before this one)"


HELD = """
import sys
import numpy as np
from starlette.applications import Starlette
from a4agent.serve import http_server

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096 / 2**20

if sys.argv[1] == "yes":
    with http_server.in_thread(Starlette()):
        pass
np.ones(24 * 2**20, np.uint8)  # freed at once, after which glibc keeps buffers up to this size
before = resident()
pictures, answers = [], []
for _ in range(20):
    pictures.append(np.ones(4 * 2**20, np.uint8))
    answers.append(bytes(100_000))  # small, and kept
pictures.clear()
print(resident() - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="about glibc's allocator")
def test_a_server_gives_the_memory_of_pictures_back() -> None:
    def growth(returned: str) -> float:
        return float(subprocess.run([sys.executable, "-c", HELD, returned], capture_output=True, check=True).stdout)

    assert growth("yes") < 10  # MiB, of 80
    assert growth("no") > 40
