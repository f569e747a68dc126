"""For all tests: no network beyond loopback, no key, no settings of the person who runs them, no time limits."""

from __future__ import annotations

import os
import signal
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "2")
os.environ["HF_HUB_OFFLINE"] = "1"
os.environ["GRADIO_ANALYTICS_ENABLED"] = "False"

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell ignores it for a suite that it starts with `&`
    signal.signal(signal.SIGINT, signal.default_int_handler)

import hypothesis
import pytest

# `--import-mode=importlib` leaves sys.path alone; the modules that tests share (servers.py) lie beside this file.
sys.path.insert(0, str(Path(__file__).parent))

from servers import FaultyServer

hypothesis.settings.register_profile("a4agent", deadline=None)  # a busy machine is not a failure
hypothesis.settings.load_profile("a4agent")

_connect = socket.socket.connect


def _loopback_only(self: socket.socket, address: Any) -> None:
    if self.family in (socket.AF_INET, socket.AF_INET6) and address[0] not in ("127.0.0.1", "::1", "localhost"):
        raise PermissionError(f"a test tried to reach {address!r}; tests use loopback only")
    _connect(self, address)


@pytest.fixture(autouse=True)
def _alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket.socket, "connect", _loopback_only)
    for variable in list(os.environ):
        if variable.startswith("A4_") or variable in ("OPENAI_API_KEY", "OPENAI_BASE_URL", "HF_TOKEN"):
            monkeypatch.delenv(variable)


@pytest.fixture
def openai_server() -> Iterator[FaultyServer]:
    """A loopback server that speaks the OpenAI protocol; see servers.py."""
    server = FaultyServer()
    yield server
    server.close()


@pytest.fixture(scope="session")
def simulator() -> None:
    """Skips what renders where mujoco, its assets or an off-screen renderer are missing."""
    from a4agent.errors import A4Error
    from a4agent.sim.assets import check_installed
    from a4agent.sim.backend import check_renderer
    from a4agent.sim.catalogue import built_in

    try:
        check_renderer()
        check_installed(built_in())
    except A4Error as error:
        pytest.skip(str(error))
