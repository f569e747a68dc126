from __future__ import annotations

import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from a4agent.errors import ConfigError
from a4agent.serve import admission
from a4agent.serve.admission import Refused

TOKEN = "a-token-of-some-length"


@pytest.mark.parametrize("host", ["127.0.0.1", "127.3.2.1", "localhost", "LOCALHOST", "::1", "[::1]"])
def test_loopback_needs_no_token(host: str) -> None:
    assert admission.is_loopback(host)
    assert admission.read_token(host, environ={}) is None


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.5", "robot.local", "", "localhost.example.org", "1"])
def test_what_others_can_reach_does_not_start_without_one(host: str) -> None:
    with pytest.raises(ConfigError, match="A4_SERVER_TOKEN or --token-file"):
        admission.read_token(host, environ={})
    assert admission.read_token(host, environ={admission.VARIABLE: TOKEN}) == TOKEN


def test_a_file_wins_over_the_environment_and_is_stripped(tmp_path: Path) -> None:
    file = tmp_path / "token"
    file.write_text(f"{TOKEN}\n")
    assert admission.read_token("0.0.0.0", file, {admission.VARIABLE: "another-token-of-length"}) == TOKEN


@pytest.mark.parametrize("content", ["", "short", "with a space in the middle", "ünicode-ünicode-ünicode"])
def test_a_token_that_would_not_protect_is_refused(tmp_path: Path, content: str) -> None:
    file = tmp_path / "token"
    file.write_text(content, encoding="utf-8")
    with pytest.raises(ConfigError, match="token"):
        admission.read_token("127.0.0.1", file, {})
    with pytest.raises(ConfigError, match="cannot be read"):
        admission.read_token("127.0.0.1", tmp_path / "none", {})


def test_an_empty_token_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "token").touch()
    with pytest.raises(ConfigError, match="token' is empty: python -c"):
        admission.read_token("127.0.0.1", tmp_path / "token", {admission.VARIABLE: TOKEN})


def test_only_the_token_admits(serve: Callable[..., Any], photo: bytes) -> None:
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
    assert call("POST", "/v1/affordances", {}, headers=elsewhere).code == 422


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


@pytest.mark.parametrize(("seconds", "header"), [(0.0, "1"), (0.2, "1"), (1.6, "2"), (60.0, "60")])
def test_retry_after_is_whole_seconds_and_never_at_once(seconds: float, header: str) -> None:
    assert Refused(503, "busy", seconds).response().headers["retry-after"] == header


def test_a_refusal_for_good_names_no_time() -> None:
    refused = Refused(413, "too large")
    assert "retry-after" not in refused.response().headers
    assert refused.body == {"error": "too large"}


def test_no_token_and_a_wrong_one_are_told_apart(serve: Callable[..., Any]) -> None:
    call = serve(token=TOKEN)
    assert "needs a token" in call("GET", "/metrics").json["error"]
    assert "token is wrong" in call("GET", "/metrics", headers={"Authorization": "Bearer not-the-token"}).json["error"]


def test_each_request_is_one_line_of_the_access_log(
    serve: Callable[..., Any], photo: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", logger="a4agent.serve.access")
    call = serve()
    call.ask(photo, "/v1/affordances?mask=none")
    call("GET", "/a%0Ab?secret=1")
    lines: list[str] = []
    deadline = time.monotonic() + 5
    while len(lines) < 2 and time.monotonic() < deadline:  # written after the answer
        time.sleep(0.01)
        lines = [record.getMessage() for record in caplog.records if record.name == "a4agent.serve.access"]
    assert re.fullmatch(r"127\.0\.0\.1 POST /v1/affordances 200 \d+\.\d{3} s", lines[0])
    assert lines[1].startswith("127.0.0.1 GET /a%0Ab 404 ")
