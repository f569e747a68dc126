"""`openai:MODEL` against an OpenAI-compatible server that nobody here wrote: `transformers serve`, tiny Qwen2.5-VL.

Needs torchvision, which that server uses; it lies in a folder of its own inside the virtual environment, so
that all other tests run without it, as users do: pip install --no-deps --target .venv/torchvision torchvision
"""

from __future__ import annotations

import importlib.util
import os
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from a4agent.errors import RequestRejected
from a4agent.experts import registry
from a4agent.protocols import ChatAnswer, ChatRequest

ROOT = Path(__file__).parents[2]
TORCHVISION = Path(sys.prefix) / "torchvision"
START_SECONDS = 120.0


@pytest.fixture(scope="module")
def served(tiny_qwen_vl: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of the server, with "/v1"."""
    for module in ("fastapi", "uvicorn", "accelerate"):
        pytest.importorskip(module)
    if not TORCHVISION.is_dir() and importlib.util.find_spec("torchvision") is None:
        pytest.skip(f"torchvision is not installed: pip install --no-deps --target {TORCHVISION} torchvision")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    folder = tmp_path_factory.mktemp("served")
    log = folder / "log.txt"
    paths = [str(TORCHVISION), *filter(None, [os.environ.get("PYTHONPATH")])]
    arguments = [str(tiny_qwen_vl), "--host", "127.0.0.1", "--port", str(port), "--device", "cpu"]
    with log.open("w") as output:
        process = subprocess.Popen(
            [sys.executable, str(ROOT / "tests" / "serve_transformers.py"), *arguments],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(paths), "HF_HUB_CACHE": str(folder)},
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    try:
        _wait_for(f"http://127.0.0.1:{port}/health", process, log)
        yield f"http://127.0.0.1:{port}/v1"
    finally:
        process.kill()
        process.wait()


def _wait_for(url: str, process: subprocess.Popen[bytes], log: Path) -> None:
    end = time.monotonic() + START_SECONDS
    while time.monotonic() < end:
        try:
            with urllib.request.urlopen(url, timeout=5):
                return
        except (urllib.error.URLError, ConnectionError, TimeoutError):
            if process.poll() is not None:
                break
            time.sleep(0.2)
    pytest.fail(f"transformers serve did not start:\n{log.read_text()[-3000:]}")


def vlm(served: str, model: Path, **settings):
    settings = {"base_url": served, "server": "transformers", "image_format": "png", "timeout": 60.0, **settings}
    return registry.create(f"openai:{model}", "vlm", settings)


def test_it_sends_what_the_same_model_gets_in_process(served, tiny_qwen_vl, noise):
    local = registry.create(f"transformers:{tiny_qwen_vl}", "vlm", {"dtype": "float32", "device": "cpu"})
    remote = vlm(served, tiny_qwen_vl)
    requests = [
        ChatRequest((noise(84, 56, 1), noise(56, 112, 2)), "Which part?", system="Be brief.", max_tokens=8),
        ChatRequest((noise(140, 84, 3),), "Which part of the mug is held?", max_tokens=8),
    ]
    for request in requests:
        (there,), (here,) = remote.chat([request]), local.chat([request])
        assert isinstance(there, ChatAnswer)
        assert isinstance(here, ChatAnswer)
        assert there.usage.tokens_in == here.usage.tokens_in  # the same pictures, at the same size, in the same order
        assert there.text.strip("\ufffd") == here.text.strip("\ufffd")
    remote.close()
    local.close()


def test_a_schema_it_does_not_know_does_no_harm(served, tiny_qwen_vl, noise):
    schema = {"type": "object", "properties": {"part": {"type": "string"}}}
    request = ChatRequest((noise(56, 56),), "Answer in JSON.", schema=schema, max_tokens=4)
    for structured in ("auto", "json_schema"):
        expert = vlm(served, tiny_qwen_vl, structured=structured)
        (answer,) = expert.chat([request])
        assert isinstance(answer, ChatAnswer)
        expert.close()


def test_a_rejection_quotes_the_server(served, tiny_qwen_vl, noise):
    expert = vlm(served, Path("/nowhere"))
    (failed,) = expert.chat([ChatRequest((noise(56, 56),), "x")])
    assert isinstance(failed, RequestRejected)
    assert str(tiny_qwen_vl) in str(failed)
    expert.close()


def test_it_is_a_detector_too(served, tiny_qwen_vl, noise):
    from a4agent.errors import AnswerError
    from a4agent.protocols import DetectRequest

    settings = {"expert": f"openai:{tiny_qwen_vl}", "base_url": served, "server": "transformers", "timeout": 60.0}
    detector = registry.create("vlm-grounding:qwen2.5-vl", "detector", {"vlm": settings, "max_tokens": 8})
    (found,) = detector.detect([DetectRequest(noise(100, 60), "the handle")])
    assert isinstance(found, AnswerError)  # random weights write no JSON; the wire carried it there and back
    detector.close()
