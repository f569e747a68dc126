"""A server in a thread, and one plain call to it."""

from __future__ import annotations

import base64
import contextlib
import http.client
import io
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

import pytest
from PIL import Image

from a4agent.agent import A4Agent
from a4agent.serve import http_server
from a4agent.serve.admission import Limits
from a4agent.serve.api import create_app
from a4agent.testing import scripted_agent


@dataclass(frozen=True)
class Answer:
    code: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


class Caller:
    """Speaks HTTP to one server."""

    def __init__(self, url: str) -> None:
        self.url = url
        self.address = urlsplit(url).netloc

    def __call__(
        self, method: str, path: str, body: Any = None, *, headers: dict[str, str] | None = None, seconds: float = 30.0
    ) -> Answer:
        connection = http.client.HTTPConnection(self.address, timeout=seconds)
        try:
            headers = dict(headers or {})
            if isinstance(body, dict | list):
                body = json.dumps(body).encode()
                headers.setdefault("Content-Type", "application/json")
            connection.request(method, path, body, headers)
            response = connection.getresponse()
            names = {name.lower(): value for name, value in response.getheaders()}
            return Answer(response.status, names, response.read())
        finally:
            connection.close()

    def ask(self, image: bytes, path: str = "/v1/affordances", **fields: Any) -> Answer:
        """The question as JSON."""
        text = base64.b64encode(image).decode()
        return self("POST", path, {"image": text, "instruction": "open the drawer", **fields})


@pytest.fixture
def serve() -> Iterator[Callable[..., Caller]]:
    """serve(agent, limits=..., token=...) -> a caller; every server ends with the test."""
    with contextlib.ExitStack() as stack:

        def start(agent: A4Agent | list[A4Agent] | None = None, **settings: Any) -> Caller:
            agents = agent if isinstance(agent, list) else [agent or scripted_agent(dream=True)]
            settings.setdefault("limits", Limits(body_bytes=2**20, pixels=1_000_000, seconds=20, upload_seconds=10))
            app = create_app(agents, profile="scripted", **settings)
            return Caller(stack.enter_context(http_server.in_thread(app)))

        yield start


@pytest.fixture(scope="session")
def photo() -> bytes:
    """A JPEG of 160 x 120 pixels."""
    file = io.BytesIO()
    Image.radial_gradient("L").resize((160, 120)).convert("RGB").save(file, "JPEG")
    return file.getvalue()
