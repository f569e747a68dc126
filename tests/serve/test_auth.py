from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from a4agent.errors import ConfigError
from a4agent.serve import auth

TOKEN = "a-token-of-some-length"


@pytest.mark.parametrize("host", ["127.0.0.1", "127.3.2.1", "localhost", "LOCALHOST", "::1", "[::1]"])
def test_loopback_needs_no_token(host: str) -> None:
    assert auth.is_loopback(host)
    assert auth.read_token(host, environ={}) is None


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.5", "robot.local", "", "localhost.example.org", "1"])
def test_what_others_can_reach_does_not_start_without_one(host: str) -> None:
    with pytest.raises(ConfigError, match="A4_SERVER_TOKEN or --token-file"):
        auth.read_token(host, environ={})
    assert auth.read_token(host, environ={auth.VARIABLE: TOKEN}) == TOKEN


def test_a_file_wins_over_the_environment_and_is_stripped(tmp_path: Path) -> None:
    file = tmp_path / "token"
    file.write_text(f"{TOKEN}\n")
    assert auth.read_token("0.0.0.0", file, {auth.VARIABLE: "another-token-of-length"}) == TOKEN


@pytest.mark.parametrize("content", ["", "short", "with a space in the middle", "ünicode-ünicode-ünicode"])
def test_a_token_that_would_not_protect_is_refused(tmp_path: Path, content: str) -> None:
    file = tmp_path / "token"
    file.write_text(content, encoding="utf-8")
    with pytest.raises(ConfigError, match="token"):
        auth.read_token("127.0.0.1", file, {})
    with pytest.raises(ConfigError, match="cannot be read"):
        auth.read_token("127.0.0.1", tmp_path / "none", {})


def test_an_empty_token_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "token").touch()
    with pytest.raises(ConfigError, match="token' is empty: python -c"):
        auth.read_token("127.0.0.1", tmp_path / "token", {auth.VARIABLE: TOKEN})


def test_only_the_token_opens_the_door(serve: Callable[..., Any], photo: bytes) -> None:
    call = serve(token=TOKEN)
    good = {"Authorization": f"Bearer {TOKEN}"}
    for headers in (
        {},
        {"Authorization": "Bearer wrong"},
        {"Authorization": f"Basic {TOKEN}"},
        {"Authorization": TOKEN},
    ):
        for method, path in (("POST", "/v1/affordances"), ("POST", "/v1/affordances/batch"), ("GET", "/metrics")):
            answer = call(method, path, headers=headers)
            assert answer.code == 401
            assert answer.headers["www-authenticate"] == "Bearer"
            assert TOKEN not in answer.body.decode()
    assert call("GET", "/healthz").code == call("GET", "/readyz").code == call("GET", "/openapi.json").code == 200
    assert call("GET", "/metrics", headers=good).code == 200
    assert call("GET", "/metrics", headers={"Authorization": f"bearer {TOKEN}"}).code == 200
    elsewhere = {**good, "Host": "robot.local:8000", "Origin": "http://robot.local"}
    assert call("POST", "/v1/affordances", {}, headers=elsewhere).code == 422  # past the door


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "evil.example:8000"},
        {"Host": "[::"},
        {"Origin": "https://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://[::"},
    ],
)
def test_a_web_page_of_others_cannot_use_an_open_server(serve: Callable[..., Any], headers: dict[str, str]) -> None:
    assert serve()("POST", "/v1/affordances", {}, headers=headers).code == 403


def test_a_local_page_can(serve: Callable[..., Any]) -> None:
    call = serve()
    assert call("POST", "/v1/affordances", {}, headers={"Origin": "http://localhost:3000"}).code == 422
    assert call("POST", "/v1/affordances", {}, headers={"Host": "localhost"}).code == 422
