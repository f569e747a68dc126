"""`a4 app` as a process. What the page does is tested with the page."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import urllib.request

import pytest

A4 = [sys.executable, "-m", "a4agent.cli.main"]


@pytest.mark.skipif(sys.platform == "win32", reason="stopped with SIGINT")
def test_it_says_where_the_page_is_and_ends_with_a_signal() -> None:
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


def test_beyond_loopback_it_needs_a_password() -> None:
    environment = {**os.environ, "A4_SERVER_TOKEN": ""}
    command = [*A4, "app", "--host", "0.0.0.0", "--port", "0"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, env=environment)
    assert done.returncode == 2
    assert "A4_SERVER_TOKEN" in done.stderr
