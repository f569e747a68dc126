"""The wire: what each failure of a real HTTP server means, and whose key goes where."""

from __future__ import annotations

import email.utils
import time

import pytest

from a4agent.errors import (
    ConfigError,
    CredentialError,
    ProviderTimeout,
    ProviderUnavailable,
    RateLimited,
    RefusedAnswer,
    RequestRejected,
    UnknownNameError,
)
from a4agent.experts.remote.connection import Connection, find_server, servers
from servers import FaultyServer, Reply, as_json, chat, error, models

JSON = {"content-type": "application/json"}


def connect(at: FaultyServer | None, /, **settings) -> Connection:
    """A connection to the server that repeats nothing, unless told otherwise."""
    base_url = at.url if at else ""
    usual = {"base_url": base_url, "server": "", "api_key_variable": "", "timeout": 5.0, "max_retries": 0}
    return Connection(settings.pop("model", "m"), **{**usual, **settings})


def call(at: FaultyServer, /, **settings):
    """One chat completion through a connection of its own."""
    connection = connect(at, **settings)
    messages = [{"role": "user", "content": "x"}]
    try:
        return connection.call(
            lambda client: client.chat.completions.with_raw_response.create(model=connection.model, messages=messages)
        )
    finally:
        connection.close()
        connection.close()


@pytest.mark.parametrize(
    ("reply", "kind", "words"),
    [
        (error(429, "slow down", retry_after="7"), RateLimited, "concurrency"),
        (error(503, "overloaded", retry_after="3"), RateLimited, "overloaded"),
        (error(500, "boom"), ProviderUnavailable, "boom"),
        (error(503, "loading model"), ProviderUnavailable, "loading model"),
        (error(409, "conflict"), ProviderUnavailable, "409"),
        (error(408, "too slow"), ProviderTimeout, "too slow"),
        (error(400, "maximum context length is 8192 tokens"), RequestRejected, "8192"),
        (error(413, "request entity too large"), RequestRejected, "413"),
        (error(422, "x" * 1000), RequestRejected, r"x \.\.\.$"),
        (error(400, "flagged", kind="content_policy_violation"), RefusedAnswer, "flagged"),
        (as_json({"detail": "no such field"}, 400), RequestRejected, "no such field"),
        (Reply(b"<html>bad gateway</html>", 502), ProviderUnavailable, "502"),
        (Reply(b"<html>hello</html>", headers={"content-type": "text/html"}), ProviderUnavailable, "hello"),
        (
            Reply(b'{"id": "x", "cho', headers=JSON),
            ProviderUnavailable,
            "not an answer",
        ),
        (Reply(chat().body, headers=JSON, cut=True), ProviderUnavailable, "reach"),
        (Reply(b"", headers=JSON), ProviderUnavailable, "not an answer"),
        (Reply(b'{"id": "\xff"}', headers=JSON), ProviderUnavailable, "not an answer"),
        (Reply(b"[" * 100_000, headers=JSON), ProviderUnavailable, "not an answer"),
    ],
)
def test_each_misbehaviour_is_its_own_error(openai_server, reply, kind, words):
    openai_server.replies(reply)
    with pytest.raises(kind, match=words) as failed:
        call(openai_server)
    assert type(failed.value) is kind
    assert "'m' at http://127.0.0.1" in str(failed.value)


def test_retry_after_is_waited_for_and_counted(openai_server):
    openai_server.replies(
        error(429, "slow down", retry_after="0.4"), error(500, "oops", retry_after="0.01"), chat("hi")
    )
    start = time.perf_counter()
    completion, sent = call(openai_server, max_retries=2)
    assert time.perf_counter() - start >= 0.4
    assert completion.choices[0].message.content == "hi"
    assert (sent.attempts, sent.request_id, len(openai_server.calls)) == (3, "req-1", 3)


@pytest.mark.parametrize(
    ("headers", "seconds"),
    [
        ({"retry_after": "7"}, 7.0),
        ({"retry_after": "0.5"}, 0.5),
        ({"retry_after_ms": "1500"}, 1.5),
        ({"retry_after": "soon"}, None),
        ({"retry_after": "nan"}, None),
        ({"retry_after": "inf"}, None),
        ({"retry_after": "-3"}, 0.0),
        ({"retry_after": "Wed, 21 Oct 2015 07:28:00"}, 0.0),
        ({"retry_after": "Wed, 21 Oct 99999 07:28:00 GMT"}, None),
        ({}, None),
    ],
)
def test_a_rate_limit_tells_when_to_come_back(openai_server, headers, seconds):
    openai_server.replies(error(429, "slow down", **headers))
    with pytest.raises(RateLimited) as failed:
        call(openai_server)
    assert failed.value.retry_after == seconds


def test_retry_after_may_be_a_date(openai_server):
    openai_server.replies(error(429, "slow", retry_after=email.utils.formatdate(time.time() + 30, usegmt=True)))
    with pytest.raises(RateLimited) as failed:
        call(openai_server)
    assert 25 < (failed.value.retry_after or 0) <= 30


@pytest.mark.parametrize("code", [401, 403])
def test_a_refused_key_stops_everything(openai_server, code):
    openai_server.replies(error(code, "Incorrect API key"))
    with pytest.raises(CredentialError, match="VLLM_API_KEY"):
        call(openai_server, server="vllm")


def test_a_key_that_was_not_sent_is_not_blamed(openai_server, monkeypatch):
    """OpenAI's key goes to OpenAI alone; a server of one's own that wants one is told how to get it."""
    monkeypatch.setenv("OPENAI_API_KEY", "x")
    openai_server.replies(error(401, "No key"))
    with pytest.raises(CredentialError, match=r"no key was sent to this address.*api_key_variable"):
        call(openai_server, server="other")
    assert "x" not in openai_server.asked()[0].headers.get("authorization", "")


def test_a_refused_custom_key_is_named(openai_server, monkeypatch):
    monkeypatch.setenv("MY_KEY", "x")
    openai_server.replies(error(401, "Incorrect API key"))
    with pytest.raises(CredentialError, match="MY_KEY"):
        call(openai_server, api_key_variable="MY_KEY")


def test_an_empty_account_stops_everything_although_it_is_a_429(openai_server):
    openai_server.replies(error(429, "You exceeded your current quota", kind="insufficient_quota"))
    with pytest.raises(CredentialError, match="credit"):
        call(openai_server)


def test_an_unknown_model_suggests_the_nearest_the_server_has(openai_server):
    openai_server.replies(error(404, "The model `qwen3-vl` does not exist"), models=models("qwen3-vl:8b", "llava"))
    with pytest.raises(UnknownNameError, match="did you mean 'qwen3-vl:8b'"):
        call(openai_server, model="qwen3-vl")


def test_a_wrong_address_is_explained(openai_server):
    openai_server.replies(Reply(b"404 page not found", 404), models=Reply(b"", 404))
    with pytest.raises(ConfigError, match="/v1"):
        call(openai_server)


def test_a_hanging_server_is_a_timeout(openai_server):
    openai_server.replies(Reply(chat().body, delay=20.0))
    start = time.perf_counter()
    with pytest.raises(ProviderTimeout, match="the setting `timeout`"):
        call(openai_server, timeout=0.3)
    assert time.perf_counter() - start < 5


def test_a_slow_server_within_the_timeout_is_waited_for(openai_server):
    slow = chat("at last")
    openai_server.replies(Reply(slow.body, headers=slow.headers, delay=0.3))
    completion, sent = call(openai_server)
    assert completion.choices[0].message.content == "at last"
    assert sent.seconds >= 0.3


def test_a_refused_connection_is_explained():
    server = FaultyServer()
    server.close()
    with pytest.raises(ProviderUnavailable, match=f"cannot reach 'm' at {server.url}"):
        call(server)


def test_a_missing_key_names_its_variable_before_anything_is_asked(monkeypatch):
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    with pytest.raises(CredentialError, match="OPENAI_API_KEY"):
        connect(None, model="gpt-4o")
    with pytest.raises(CredentialError, match="MY_KEY"):
        connect(None, base_url="http://127.0.0.1:9/v1", api_key_variable="MY_KEY")


def test_another_place_in_the_environment_is_named_and_not_ignored(monkeypatch):
    """Pictures went to OpenAI although OPENAI_BASE_URL named another server."""
    monkeypatch.setenv("OPENAI_API_KEY", "x")
    monkeypatch.setenv("OPENAI_BASE_URL", "http://127.0.0.1:9/v1/")
    with pytest.raises(ConfigError, match=r"OPENAI_BASE_URL is 'http://127.0.0.1:9/v1'.*base_url"):
        connect(None, model="gpt-4o")
    assert connect(None, base_url="http://127.0.0.1:8/v1").base_url == "http://127.0.0.1:8/v1"
    assert connect(None, base_url="https://api.openai.com/v1").server.name == "openai"
    monkeypatch.setenv("OPENAI_BASE_URL", "https://api.openai.com/v1/")
    assert connect(None, model="gpt-4o").base_url == "https://api.openai.com/v1"


def test_a_vendors_key_is_not_sent_to_another_server(openai_server, monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", "sk-secret")
    call(openai_server)
    call(openai_server, api_key_variable="OPENAI_API_KEY")
    kept, named = (asked.headers["authorization"] for asked in openai_server.calls)
    assert "sk-secret" not in kept
    assert named == "Bearer sk-secret"


@pytest.mark.parametrize(
    ("base_url", "name"),
    [
        ("", "openai"),
        ("https://api.openai.com/v1", "openai"),
        ("http://127.0.0.1:8000/v1", "vllm"),
        ("http://gpu-box:30000/v1", "sglang"),
        ("http://localhost:11434/v1", "ollama"),
        ("http://localhost:8080/v1", "llama.cpp"),
        ("https://example.org/api/v1", "other"),
    ],
)
def test_a_server_is_known_by_its_address(base_url, name):
    assert find_server("", base_url).name == name


@pytest.mark.parametrize("base_url", ["localhost:8000", "http://127.0.0.1:99999/v1", "http://[::1/v1", "ftp://x/v1"])
def test_an_invalid_url_raises(base_url):
    with pytest.raises(ConfigError, match="is not a URL"):
        connect(None, base_url=base_url)


def test_the_table_of_servers_is_complete():
    for name, server in servers().items():
        assert server.structured[-1] == "text", name
        assert server.schema_shape in ("nested", "flat"), name
        assert name == "other" or find_server(name) == server
