"""What docs/security.md promises: each statement has its tests, and nothing needs a network."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "security.md").read_text(encoding="utf-8")

WITHOUT_A_NETWORK = """
import subprocess, sys, urllib.request
subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
from a4agent.cli.main import main

def a4(*arguments):
    try:
        main(list(arguments))
    except SystemExit as end:
        assert end.code == 0, (arguments, end.code)

a4("predict", "examples/coffee.jpg", "fill the cup", "--out", sys.argv[1] + "/predicted")
a4("bench", "folder", "--data", "examples", "--limit", "1", "--out", sys.argv[1] + "/run")

from a4agent import A4Agent
from a4agent.client import Client
from a4agent.config import load_settings
from a4agent.serve import http_server
from a4agent.serve.api import create_app
with http_server.in_thread(create_app([A4Agent.from_profile("offline")])) as url:
    assert Client(url).predict("examples/coffee.jpg", "fill the cup").status in ("ok", "abstained")
if sys.argv[2] == "page":
    from a4agent.serve.page import create_page
    with http_server.in_thread(create_page(load_settings)) as url:
        assert b"gradio" in urllib.request.urlopen(url, timeout=60).read()
print("done")
"""


def statements() -> list[str]:
    return [" ".join(item.split()) for item in re.findall(r"^- (.*?)(?=\n- |\n\n|\Z)", PAGE, re.MULTILINE | re.DOTALL)]


def test_every_statement_names_tests_that_exist() -> None:
    known = {
        node.name
        for path in (ROOT / "tests").rglob("test_*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef)
    }
    refused, _, _ = PAGE.partition("## Not defended")
    assert len(statements()) > 30
    for statement in statements():
        named = re.findall(r"`(test_\w+)`", statement)
        assert named or " ".join(refused.split()).find(statement) < 0, statement
        assert set(named) <= known, set(named) - known


@pytest.mark.skipif(shutil.which("unshare") is None or os.geteuid() != 0, reason="closes the network as root")
def test_everything_runs_without_a_network(tmp_path: Path) -> None:
    allowed = subprocess.run(["unshare", "-n", "ip", "link", "set", "lo", "up"], capture_output=True)
    if allowed.returncode:
        pytest.skip("this machine gives no network namespace")
    try:
        import gradio  # noqa: F401  # pyright: ignore

        page = "page"
    except ImportError:
        page = "no page"
    command = ["unshare", "-n", sys.executable, "-W", "ignore", "-c", WITHOUT_A_NETWORK, str(tmp_path), page]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-3000:]
    assert done.stdout.endswith("done\n")
