"""Batches through the queue, and callers who leave."""

from __future__ import annotations

import base64
import http.client
import json
import time
from collections.abc import Callable
from typing import Any

from a4agent.agent import A4Agent
from a4agent.stages.spotter import Spotter
from a4agent.stages.thinker import Thinker
from a4agent.testing import ScriptedDetector, ScriptedSegmenter, ScriptedVLM, output


def test_a_batch_stops_when_its_caller_is_gone(serve: Callable[..., Any], photo: bytes) -> None:
    vlm = ScriptedVLM(lambda request: time.sleep(0.1) or output("the knob"))
    call = serve(A4Agent(None, Thinker(vlm), Spotter(ScriptedDetector(), ScriptedSegmenter())))
    sample = {"image": base64.b64encode(photo).decode(), "instruction": "open"}
    body = json.dumps({"samples": [{**sample, "instruction": f"open {n}"} for n in range(16)]}).encode()
    connection = http.client.HTTPConnection(call.address)
    connection.request("POST", "/v1/affordances/batch", body, {"Content-Type": "application/json"})
    while not vlm.requests:
        time.sleep(0.01)
    connection.close()
    assert call.ask(photo).code == 200  # waits for the worker, which the batch gives back
    assert len(vlm.requests) < 14  # not all 16 and the last
