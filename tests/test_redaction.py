"""Secrets stay inside: one type, one filter, and a search through everything that a run, report and server write."""

from __future__ import annotations

import base64
import http.client
import itertools
import json
import logging
import pickle
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

import pytest

import pictures
from a4agent.agent import A4Agent
from a4agent.cli.main import main
from a4agent.config import ExpertSettings, load_settings
from a4agent.errors import ProviderError, RateLimited
from a4agent.experts import registry
from a4agent.redaction import Secret, conceal, redact, reveal
from a4agent.testing import ScriptedDetector, ScriptedEditor, ScriptedSegmenter
from servers import Call, FaultyServer, Reply, chat, error


def test_a_secret_shows_itself_to_no_one_but_who_reveals_it() -> None:
    secret = Secret("open-sesame")
    assert f"{secret} {secret!r} {[secret]}" == "*** *** [***]"
    assert secret.reveal() == "open-sesame"
    assert secret == Secret("open-sesame") != Secret("other-word")
    assert len({secret, Secret("open-sesame")}) == 1
    assert pickle.loads(pickle.dumps(secret)) == secret
    assert not Secret("")


def test_a_remembered_secret_is_replaced_in_every_form() -> None:
    text = Secret('q"7&\\x/é=').reveal()
    for form in (text, json.dumps(text), repr(text), quote(text, safe=""), "q&quot;7&amp;\\x/é="):
        assert redact(f"before {form} after").replace("'", "").replace('"', "") == "before *** after"


@pytest.mark.parametrize(
    ("text", "clean"),
    [
        ("at http://me:pw@host/v1 now", "at http://***@host/v1 now"),
        ("at http://token-of-mine@host:80", "at http://***@host:80"),
        ("Authorization: Bearer abcdefghij0123456789", "Authorization: Bearer ***"),
        ("GET /v1?api_key=abc&x=1", "GET /v1?api_key=***&x=1"),
        ("key sk-proj-abcdefghijklmnop1234 refused", "key *** refused"),
        (f"hf_{'a' * 34}", "***"),
        ("mail me@example.com about max_tokens = 3", "mail me@example.com about max_tokens = 3"),
        ("the bearer of the tray", "the bearer of the tray"),
        ("ask sk-short", "ask sk-short"),
    ],
)
def test_forms_of_secrets_that_nobody_made_known(text: str, clean: str) -> None:
    assert redact(text) == clean


def test_variables_of_the_environment_with_secret_names_are_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOME_API_KEY", "from-the-environment")
    monkeypatch.setenv("SOME_PLACE", "a-folder-of-mine")
    monkeypatch.setenv("OTHER_KEY", "1")  # too short to be looked for
    assert redact("from-the-environment in a-folder-of-mine, 1") == "*** in a-folder-of-mine, 1"


def test_of_two_secrets_the_longer_one_is_replaced_as_a_whole() -> None:
    Secret("abcdef"), Secret("abcdef-and-more")
    assert redact("abcdef-and-more abcdef") == "*** ***"


def test_settings_are_concealed_by_name_and_revealed_again() -> None:
    settings = {
        "api_key": "one-of-five",
        "extra": {"api-key": "two-of-five", "top_k": 1, "stop": ["x"]},
        "extra_headers": {"X-Anything": "three-of-five"},
        "max_tokens": 9,
        "api_key_variable": "MY_KEY",
        "token": "",
    }
    hidden = conceal(settings)
    assert (hidden["api_key"], hidden["extra"]["api-key"]) == (Secret("one-of-five"), Secret("two-of-five"))
    assert hidden["extra_headers"] == {"X-Anything": Secret("three-of-five")}
    assert (hidden["max_tokens"], hidden["api_key_variable"], hidden["token"]) == (9, "MY_KEY", "")
    assert reveal(hidden) == settings
    assert conceal(hidden) == hidden
    assert redact(hidden)["extra"] == {"api-key": "***", "top_k": 1, "stop": ["x"]}


def test_credentials_of_a_url_are_remembered_as_they_are_sent() -> None:
    conceal({"base_url": "http://ann:p%40ssword-of-ann@host/v1"})
    sent = base64.b64encode(b"ann:p@ssword-of-ann").decode()
    assert redact(f"Basic {sent}, p@ssword-of-ann") == "Basic ***, ***"


def test_an_error_never_holds_a_secret() -> None:
    Secret("in-an-error")
    assert str(ProviderError("refused in-an-error")) == "refused ***"
    limited = RateLimited("slow down, in-an-error", 3.0)
    assert (str(limited), limited.retry_after) == ("slow down, ***", 3.0)


def test_a_log_record_never_holds_a_secret(caplog: pytest.LogCaptureFixture) -> None:
    Secret("in-a-log-line")
    try:
        raise ValueError("in-a-log-line")
    except ValueError:
        logging.getLogger("a4agent").exception("bad %s", "in-a-log-line")
    assert "in-a-log-line" not in caplog.text
    assert "bad ***" in caplog.text
    assert "ValueError: ***" in caplog.text


def test_settings_keep_secrets_from_the_moment_they_are_read(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('[spotter]\ndetector = {expert = "x:y", api_key = "from-the-file"}\n')
    settings = load_settings(
        tmp_path / "mine.toml", {"spotter.detector.password": "from-a-flag"}, environ={}, folder=tmp_path
    )
    assert settings.spotter.detector.settings == {"api_key": Secret("from-the-file"), "password": Secret("from-a-flag")}
    assert not re.search("from-a-flag|from-the-file", settings.model_dump_json() + repr(settings) + str(settings))


def test_experts_that_differ_in_a_secret_alone_are_two(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(registry.plugins.added, "keyed", lambda model, role, *, api_key: ScriptedDetector(id=api_key))
    specs = {
        f"{stage}.detector": ExpertSettings.model_validate({"expert": "keyed:x", "api_key": key})
        for stage, key in (("a", "first-key"), ("b", "second-key"), ("c", "first-key"))
    }
    built = registry.build(specs)
    assert built["a.detector"] is built["c.detector"] is not built["b.detector"]
    assert built["b.detector"].id == "second-key"


PROFILE = """
[dreamer]
editor = "stranger:editor"
[dreamer.vlm]
expert = "openai:m"
base_url = "http://me:PLANTED-1-url@HOST/v1"
max_retries = 0
[thinker]
reasks = 0
[thinker.vlm]
expert = "openai:m"
base_url = "http://HOST/v1?api_key=PLANTED-2-query"
api_key_variable = "PLANTED_API_KEY"
max_retries = 0
extra = {api_key = "PLANTED-3-extra"}
[spotter.detector]
expert = "stranger:detector"
api_key = "PLANTED-4-setting"
extra_headers = {X-Custom = "PLANTED-5-header"}
[spotter.segmenter]
expert = "stranger:segmenter"
[engine]
cache = "write"
cache_dir = "cache"
retries = 0
"""


class StrangersDetector(ScriptedDetector):
    """Fails with its own secrets in the message, and tells its settings as they are."""

    def __init__(self, settings: Mapping[str, Any]) -> None:
        super().__init__(self._refuse, id="stranger:detector")
        self.settings = dict(settings)

    def _refuse(self, request: Any) -> Any:
        logging.getLogger("a4agent").warning("the detector was asked with %s", self.settings)
        if pictures.number_of(request.image) % 2:
            return ProviderError(f"refused: {self.settings}")
        raise RuntimeError(f"broken: {self.settings}")


def stranger(model: str, role: str, **settings: Any) -> Any:
    if role == "editor":
        return ScriptedEditor(id="stranger:editor")
    return StrangersDetector(settings) if role == "detector" else ScriptedSegmenter(id="stranger:segmenter")


def test_ten_planted_secrets_are_in_nothing_that_is_written(
    openai_server: FaultyServer,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    from a4agent.serve import http_server
    from a4agent.serve.api import create_app

    number = itertools.count()

    def reply(call: Call) -> Reply:
        echoed = f"{call.headers.get('authorization', '')} {json.dumps(call.json)[-300:]}"
        if next(number) % 3 == 0:
            return error(400, f"what is this: {echoed}")
        return chat(f'I see {echoed}.\n### Output\n{{"task": "t", "object_name": "o", "object_part": "part"}}')

    openai_server.replies(reply)
    pictures.write_folder(tmp_path / "data", 8)
    (tmp_path / "p.toml").write_text(PROFILE.replace("HOST", urlsplit(openai_server.url).netloc))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(registry.plugins.added, "stranger", stranger)
    monkeypatch.setenv("PLANTED_API_KEY", "PLANTED-6-environment")
    monkeypatch.setenv("HF_TOKEN", "PLANTED-7-hub-token")
    monkeypatch.setenv("A4_THINKER__VLM__EXTRA__PASSWORD", "PLANTED-8-variable")
    flags = ("--set", "spotter.detector.token=PLANTED-9-flag", "--set", "thinker.vlm.extra.secret=PLANTED-10-flag")
    arguments = ["bench", "folder", "--data", "data", "--profile", "p.toml", "--out", "run", *flags]
    monkeypatch.setattr("sys.argv", ["a4", *arguments])
    for command in (arguments, ["report", "run"]):
        with pytest.raises(SystemExit) as ended:
            main(command)
        assert ended.value.code in (0, 1)
    basic = base64.b64encode(b"me:PLANTED-1-url").decode()
    assert any(basic in str(call.headers) for call in openai_server.calls)
    assert any("PLANTED-6-environment" in str(call.headers) for call in openai_server.calls)  # it was sent
    assert any("PLANTED-3-extra" in str(call.json) for call in openai_server.calls)

    answers: list[str] = []
    overrides = {"spotter.detector.token": "PLANTED-9-flag", "thinker.vlm.extra.secret": "PLANTED-10-flag"}
    agent = A4Agent.from_settings(load_settings("p.toml", overrides))
    with agent, http_server.in_thread(create_app([agent], profile="p.toml")) as url:
        for path in ("/readyz", "/healthz", "/metrics", "/v1/affordances"):
            connection = http.client.HTTPConnection(urlsplit(url).netloc, timeout=30)
            body = b"" if path != "/v1/affordances" else (tmp_path / "data" / "1.png").read_bytes()
            connection.request("POST" if body else "GET", f"{path}?instruction=open", body or None)
            answers.append(connection.getresponse().read().decode())
            connection.close()

    written = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file() and path.name != "p.toml"}
    assert {"manifest.json", "samples.jsonl", "report.html"} <= {path.name for path in written}
    assert any(path.suffix == ".entry" for path in written)
    rows = (tmp_path / "run" / "samples.jsonl").read_text()
    for echo in (r"what is this: (Basic|Bearer) \*\*\*", r"I see (Basic|Bearer) \*\*\*", "broken: {|refused: {"):
        assert re.search(echo, rows)
    texts = {str(path): data.decode("utf-8", "replace") for path, data in written.items()}
    texts |= {"server": "\n".join(answers), "terminal": "".join(capfd.readouterr()), "log": caplog.text}
    assert "the detector was asked with" in texts["log"]
    leaks = {
        (name, found) for name, text in texts.items() for found in re.findall(rf"PLANTED-\d+-[a-z]+|{basic}", text)
    }
    assert not leaks
