from __future__ import annotations

import re
from typing import Any

import pytest

from a4agent.serve.api import create_app
from a4agent.testing import scripted_agent

SINGLE, BATCH = "/v1/affordances", "/v1/affordances/batch"


def schema(**settings: Any) -> dict[str, Any]:
    return create_app([scripted_agent()], **settings).openapi()


def test_every_endpoint_names_its_errors_and_both_bodies() -> None:
    paths = schema()["paths"]
    assert set(paths) == {SINGLE, BATCH, "/healthz", "/readyz", "/metrics"}
    single = paths[SINGLE]["post"]
    assert set(single["requestBody"]["content"]) == {"application/json", "multipart/form-data"}
    assert set(single["responses"]) == {"200", "400", "401", "403", "408", "413", "415", "422", "503"}
    assert set(single["responses"]["200"]["content"]) == {"application/json", "text/event-stream"}
    assert "Retry-After" in single["responses"]["503"]["headers"]


def test_a_token_is_declared_where_it_is_needed() -> None:
    assert "securitySchemes" not in schema().get("components", {})
    guarded = schema(token="a-token-of-some-length")
    assert guarded["components"]["securitySchemes"]["token"]["scheme"] == "bearer"
    assert guarded["paths"][SINGLE]["post"]["security"] == [{"token": []}]
    assert guarded["paths"]["/metrics"]["get"]["security"] == [{"token": []}]
    assert "security" not in guarded["paths"]["/healthz"]["get"]


@pytest.mark.parametrize(("path", "name"), [(SINGLE, "mug"), (BATCH, "two")])
def test_the_examples_work(serve: Any, path: str, name: str) -> None:
    call = serve()
    declared = call("GET", "/openapi.json").json["paths"][path]["post"]["requestBody"]["content"]["application/json"]
    answer = call("POST", path, declared["examples"][name]["value"])
    assert answer.code == 200
    first = answer.json["affordances"][0] if path == BATCH else answer.json
    assert first["status"] == "ok"


def test_the_docs_page_describes_every_endpoint_and_loads_nothing(serve: Any) -> None:
    call = serve(token="a-token-of-some-length")
    page = call("GET", "/docs")
    assert page.code == 200
    text = page.body.decode()
    for path in (SINGLE, BATCH, "/healthz", "/readyz", "/metrics"):
        assert f" {path}</code>" in text
    assert "Authorization: Bearer TOKEN" in text
    assert not re.search(r"<script|<link|src=|https?://(?!127)", text)
    index = call("GET", "/").body.decode()
    assert 'href="/docs"' in index
    assert "POST /v1/affordances" in index
