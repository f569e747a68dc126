"""`a4 serve` and `a4 app` as processes: what they say and refuse, and that a signal loses no request."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from a4agent.cli.serve import _agents
from a4agent.client import Affordance, Client, ServerError
from a4agent.errors import ConfigError
from a4agent.serve import EXAMPLES_FOLDER
from a4agent.testing import scripted_agent

A4 = [sys.executable, "-m", "a4agent.cli.main"]
PHOTO = EXAMPLES_FOLDER / "drawer.jpg"
TOKEN = "a-token-of-some-length"


class Process:
    """A running command and the URL that its first line on stderr names."""

    def __init__(self, *arguments: str) -> None:
        self.process = subprocess.Popen([*A4, *arguments], stderr=subprocess.PIPE, text=True)
        assert self.process.stderr
        self.line = self.process.stderr.readline()
        found = re.search(r"http://\S+", self.line)
        assert found, self.line + self.process.stderr.read()
        self.url = found[0].rstrip(";")

    def stop(self, number: int = signal.SIGTERM) -> str:
        self.process.send_signal(number)
        _, rest = self.process.communicate(timeout=60)
        return rest


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Process]:
    file = tmp_path / "token"
    file.write_text(TOKEN)
    process = Process("serve", "--profile", "offline", "--port", "0", "--token-file", str(file), "--queue", "4")
    yield process
    if process.process.poll() is None:
        process.stop()


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*A4, *arguments], capture_output=True, text=True, timeout=60)


@pytest.mark.skipif(sys.platform == "win32", reason="SIGTERM ends a Windows process at once")
def test_a_signal_lets_what_is_in_flight_finish_and_takes_no_more(server: Process) -> None:
    assert "offline" in server.line
    assert server.line.endswith("with a token; Ctrl+C ends\n")
    client = Client(server.url, TOKEN, retries=0)
    assert client.ready()
    sure = client.predict(PHOTO, "open the drawer").status
    assert sure in ("ok", "abstained")
    answers: list[Affordance] = []
    in_flight = threading.Barrier(4)

    def ask() -> None:
        events = Client(server.url, TOKEN, retries=0).stream(PHOTO, "open the drawer")
        assert next(events)[0] == "queued"
        in_flight.wait(30)
        answers.append(list(events)[-1][1])

    threads = [threading.Thread(target=ask) for _ in range(3)]
    for thread in threads:
        thread.start()
    in_flight.wait(30)
    rest = server.stop()
    for thread in threads:
        thread.join(60)
    assert [answer.status for answer in answers] == [sure] * 3
    assert "Traceback" not in rest
    with pytest.raises(ServerError, match="cannot be reached"):
        client.predict(PHOTO, "open the drawer")


def test_a_host_that_others_can_reach_needs_a_token_to_start() -> None:
    done = run("serve", "--host", "0.0.0.0", "--port", "0")
    assert done.returncode == 2
    assert "A4_SERVER_TOKEN or --token-file" in done.stderr
    assert "Traceback" not in done.stderr


def test_no_time_for_ever() -> None:
    done = run("serve", "--port", "0", "--seconds", "inf")
    assert done.returncode == 2
    assert "Traceback" not in done.stderr


def test_a_port_that_is_taken_is_a_sentence(server: Process) -> None:
    port = server.url.rpartition(":")[2]
    done = run("serve", "--port", port)
    assert done.returncode == 2
    assert f"127.0.0.1:{port}" in done.stderr
    assert "choose another --port" in " ".join(done.stderr.split())


def test_workers_need_experts_that_take_as_many_calls() -> None:
    agent = scripted_agent(concurrency=3)
    assert _agents(agent, 3) == [agent] * 3
    with pytest.raises(ConfigError, match="CUDA_VISIBLE_DEVICES"):
        _agents(agent, 4)


@pytest.mark.skipif(sys.platform == "win32", reason="stopped with SIGINT")
def test_the_page_says_where_it_is_and_ends_with_a_signal() -> None:
    pytest.importorskip("gradio", reason="needs the extra app")
    process = subprocess.Popen([*A4, "app", "--port", "0"], stderr=subprocess.PIPE, text=True)
    assert process.stderr
    line = process.stderr.readline()
    found = re.search(r"http://127\.0\.0\.1:\d+", line)
    assert found, line
    with urllib.request.urlopen(found[0], timeout=60) as answer:
        assert "Where do I act?" in answer.read().decode()
        assert "default-src 'self'" in answer.headers["content-security-policy"]
    process.send_signal(signal.SIGINT)
    _, rest = process.communicate(timeout=60)
    assert "Traceback" not in rest


def test_beyond_loopback_the_page_needs_a_password() -> None:
    environment = {**os.environ, "A4_SERVER_TOKEN": ""}
    command = [*A4, "app", "--host", "0.0.0.0", "--port", "0"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, env=environment)
    assert done.returncode == 2
    assert "A4_SERVER_TOKEN" in done.stderr
