from __future__ import annotations

import http.client
import threading

import pytest
from starlette.applications import Starlette
from starlette.responses import PlainTextResponse
from starlette.routing import Route

from a4agent.errors import ConfigError
from a4agent.serve import run


def test_a_free_port_is_found_and_named() -> None:
    with run.bind("127.0.0.1", 0) as listening:
        port = listening.getsockname()[1]
        assert run.url_of(listening) == f"http://127.0.0.1:{port}"
        with pytest.raises(ConfigError, match=f"127.0.0.1:{port}.*choose another --port"):
            run.bind("127.0.0.1", port)


def test_addresses_of_both_kinds() -> None:
    try:
        listening = run.bind("::1", 0)
    except ConfigError:
        pytest.skip("this machine has no IPv6")
    with listening:
        assert run.url_of(listening).startswith("http://[::1]:")


def test_a_host_that_is_not_ours_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"192\.0\.2\.1"):
        run.bind("192.0.2.1", 0)


def test_a_server_in_a_thread_ends_with_its_block() -> None:
    async def hello(request: object) -> PlainTextResponse:
        return PlainTextResponse("hello")

    with run.in_thread(Starlette(routes=[Route("/", hello)])) as url:
        connection = http.client.HTTPConnection(url.removeprefix("http://"))
        connection.request("GET", "/")
        answer = connection.getresponse()
        assert answer.read() == b"hello"
        assert answer.getheader("server") is None
        connection.close()
    assert not any(thread.name == "a4-serve" for thread in threading.enumerate())
