"""The server held to its own OpenAPI: generated requests, good and bad, must be answered as the schema says."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from a4agent.serve.admission import Limits

TOKEN = "a-token-of-some-length"
# A schema cannot say which bytes are a picture, so that most of what it allows is refused, and rightly.
UNFIT = "positive_data_acceptance"


def test_every_generated_request_is_answered_as_the_schema_says(serve: Callable[..., Any], tmp_path: Path) -> None:
    pytest.importorskip("schemathesis", reason="generates the requests")
    call = serve(token=TOKEN, limits=Limits(body_bytes=2**20, queue=32, batch=4))
    command = [sys.executable, "-m", "schemathesis.cli", "run", f"{call.url}/openapi.json", "--no-color"]
    command += ["--checks", "all", "--exclude-checks", UNFIT, "--phases", "examples,coverage,fuzzing"]
    command += ["--max-examples", "8", "--generation-deterministic", "--workers", "1"]
    command += ["--header", f"Authorization: Bearer {TOKEN}"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    generated = re.search(r"(\d+) generated, (\d+) passed", done.stdout)
    assert generated
    assert int(generated[2]) > 100
    text = call("GET", "/metrics", headers={"Authorization": f"Bearer {TOKEN}"}).body.decode()
    codes = {int(code) for code in re.findall(r'a4_requests_total\{code="(\d+)"', text)}
    assert {200, 401, 415, 422} <= codes
    assert not {code for code in codes if code >= 500}
