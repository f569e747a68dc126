"""A short run of the load benchmark, whose exit code is its verdict."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "perf" / "serve.py"


@pytest.mark.skipif(sys.platform == "win32", reason="reads memory with ps")
def test_sixteen_clients_lose_no_answer_and_leave_no_memory_behind() -> None:
    command = [sys.executable, str(SCRIPT), "--seconds", "5", "--clients", "16", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout)
    assert found["sent"] == sum(found["codes"].values())
    assert set(found["codes"]) == {"200", "422", "503"}
    assert found["codes"]["200"] >= 20
