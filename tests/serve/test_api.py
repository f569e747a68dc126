"""The API over real sockets: what comes back, and what is refused with which code."""

from __future__ import annotations

import base64
import http.client
import io
import json
import socket
import struct
import threading
import time
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from PIL import Image

from a4agent.acting.lifting import Intrinsics
from a4agent.acting.plan import plan_action
from a4agent.agent import A4Agent
from a4agent.errors import CredentialError, UnreadableAnswer
from a4agent.serve.admission import Limits
from a4agent.stages.spotter import Spotter
from a4agent.stages.thinker import Thinker
from a4agent.testing import ScriptedDetector, ScriptedSegmenter, ScriptedVLM, output, scripted_agent
from a4agent.types import Affordance

Serve = Callable[..., Any]
ONE, BATCH = "/v1/affordances", "/v1/affordances/batch"
SMALL = Limits(body_bytes=2**16, pixels=100_000, queue=1, seconds=1.0, upload_seconds=0.5, batch=2)


def form(image: bytes | None, filename: str | None = "photo.jpg", **fields: str) -> tuple[bytes, dict[str, str]]:
    body = b""
    for name, value in fields.items():
        body += f'--B\r\nContent-Disposition: form-data; name="{name}"\r\n\r\n{value}\r\n'.encode()
    if image is not None:
        name = f'; filename="{filename}"' if filename else ""
        body += f'--B\r\nContent-Disposition: form-data; name="image"{name}\r\n\r\n'.encode() + image + b"\r\n"
    return body + b"--B--\r\n", {"Content-Type": "multipart/form-data; boundary=B"}


def without_times(data: dict[str, Any]) -> dict[str, Any]:
    return {**data, "trace": [{**step, "seconds": 0} for step in data["trace"]]}


def events_of(body: bytes) -> list[tuple[str, Any]]:
    blocks = [block for block in body.decode().split("\n\n") if block and not block.startswith(":")]
    lines = [block.split("\n") for block in blocks]
    return [(name.removeprefix("event: "), json.loads(data.removeprefix("data: "))) for name, data in lines]


def png_claiming(width: int, height: int) -> bytes:
    """A tiny PNG file whose header claims any size: a decompression bomb."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    pixels = zlib.compress(bytes(100_000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def test_a_form_and_a_json_body_give_what_predict_gives(serve: Serve, photo: bytes) -> None:
    call = serve()
    expected = scripted_agent(dream=True).predict(photo, "open the drawer").to_dict()
    expected["regions"][0]["mask"] = None  # it is the answer's
    expected["action"] = plan_action(Affordance.from_dict(expected)).to_dict()
    body, headers = form(photo, instruction="open the drawer", id="7")
    from_form = call("POST", ONE, body, headers=headers)
    from_json = call.ask(photo)
    assert from_form.code == from_json.code == 200
    assert without_times(from_json.json) == without_times(expected)
    assert without_times(from_form.json) == without_times({**expected, "id": "7"})
    assert (Affordance.from_dict(from_json.json).mask == Affordance.from_dict(expected).mask).all()


def test_depth_gives_contacts_in_metres_and_grasps(serve: Serve, photo: bytes) -> None:
    call = serve()
    camera = {"fx": 200.0, "fy": 200.0, "cx": 79.5, "cy": 59.5}
    millimetres = np.full((120, 160), 700, np.uint16)
    millimetres[50:70, 70:90] = 500  # the part of the scripted segmenter lies nearer
    file = io.BytesIO()
    Image.fromarray(millimetres).save(file, "PNG")
    depth = base64.b64encode(file.getvalue()).decode()
    fields = {"image": base64.b64encode(photo).decode(), "instruction": "open", "depth": depth, "camera": camera}
    action = call("POST", ONE, json.dumps(fields).encode(), headers={"Content-Type": "application/json"}).json["action"]
    answer = Affordance.from_dict(call.ask(photo).json)
    expected = plan_action(answer, depth=millimetres / 1000, camera=Intrinsics(**camera)).to_dict()
    assert action == expected
    assert action["contacts"][0]["position_xyz"] is not None
    body = {"samples": [fields, {**fields, "depth": None}]}
    both = call("POST", BATCH, json.dumps(body).encode(), headers={"Content-Type": "application/json"}).json
    assert [row["action"]["contacts"][0]["position_xyz"] is None for row in both["affordances"]] == [False, True]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"camera": None}, "camera: it is needed"),
        ({"camera": {"fx": 0, "fy": 1, "cx": 0, "cy": 0}}, "camera.fx: "),
        ({"camera": {"fx": 1, "fy": 1, "cx": "NaN", "cy": 0}}, "camera.cx: "),
        ({"depth": "http://host/a.png"}, "depth: this server fetches no URLs"),
        ({"depth": "%%%"}, "depth: not base64"),
        ({"depth": base64.b64encode(b"no picture").decode()}, "depth: "),
        ({"depth_scale": 0}, "depth_scale: "),
    ],
)
def test_depth_that_cannot_be_used_is_refused_by_name(
    changes: dict[str, Any], reason: str, serve: Serve, photo: bytes
) -> None:
    file = io.BytesIO()
    Image.new("I;16", (160, 120), 500).save(file, "PNG")
    fields: dict[str, Any] = {
        "image": base64.b64encode(photo).decode(),
        "instruction": "open",
        "depth": base64.b64encode(file.getvalue()).decode(),
        "camera": {"fx": 200, "fy": 200, "cx": 80, "cy": 60},
        **changes,
    }
    answer = serve()("POST", ONE, json.dumps(fields).encode(), headers={"Content-Type": "application/json"})
    assert answer.code == 422
    assert answer.json["error"].startswith(reason)


def test_masks_come_as_asked(serve: Serve, photo: bytes) -> None:
    call = serve()
    truth = Affordance.from_dict(call.ask(photo).json).mask
    as_png = call.ask(photo, f"{ONE}?mask=png&imagination=png").json
    pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(as_png["mask"]["png"]))))
    assert ((pixels == 255) == truth).all()
    assert as_png["mask"]["size"] == [120, 160]
    assert Image.open(io.BytesIO(base64.b64decode(as_png["imagination"]["png"]))).size == (160, 120)
    without = call.ask(photo, f"{ONE}?mask=none").json
    assert without["mask"] is None
    assert without["regions"][0]["mask"] is None
    assert call.ask(photo, f"{ONE}?mask=jpeg").code == 422


def test_a_stream_tells_the_stages_in_order_and_ends_with_the_same_answer(serve: Serve, photo: bytes) -> None:
    call = serve()
    answer = call.ask(photo, f"{ONE}?stream=1")
    assert answer.headers["content-type"].startswith("text/event-stream")
    events = events_of(answer.body)
    assert [name for name, _ in events] == ["queued", "imagination", "target", "detection", "affordance"]
    found = dict(events)
    assert found["queued"] == {"position": 0}
    assert found["target"]["object_part"] == "the handle of the thing"
    assert found["detection"]["boxes_xyxy"] == [[40, 30, 120, 90]]
    assert without_times(found["affordance"]) == without_times(call.ask(photo).json)


def test_stages_arrive_while_later_ones_still_work(serve: Serve, photo: bytes) -> None:
    call = serve(scripted_agent(dream=True, seconds=0.3))
    text = base64.b64encode(photo).decode()
    connection = http.client.HTTPConnection(call.address)
    body = json.dumps({"image": text, "instruction": "open"}).encode()
    connection.request("POST", f"{ONE}?stream=1", body, {"Content-Type": "application/json"})
    response = connection.getresponse()
    times = {}
    for line in response:
        if line.startswith(b"event: "):
            times[line[7:].strip().decode()] = time.monotonic()
    connection.close()
    assert times["target"] - times["imagination"] > 0.2
    assert times["affordance"] - times["target"] > 0.4


def test_a_known_part_asks_the_spotter_only(serve: Serve, photo: bytes) -> None:
    agent = scripted_agent(dream=True)
    data = serve(agent).ask(photo, part="the knob").json
    assert data["target"]["object_part"] == "the knob"
    assert [step["stage"] for step in data["trace"]] == ["spotter", "spotter"]


def test_a_batch_answers_in_order_and_one_bad_picture_spoils_no_other(serve: Serve, photo: bytes) -> None:
    call = serve()
    good = base64.b64encode(photo).decode()
    samples = [
        {"image": good, "instruction": "first", "id": "a"},
        {"image": base64.b64encode(photo[:200]).decode(), "instruction": "second", "id": "b"},
        {"image": good, "instruction": "third", "id": "c"},
    ]
    answer = call("POST", BATCH, {"samples": samples})
    assert answer.code == 200
    first, second, third = answer.json["affordances"]
    assert [first["id"], second["id"], third["id"]] == ["a", "b", "c"]
    assert [first["status"], second["status"], third["status"]] == ["ok", "error", "ok"]
    assert "damaged or cut off" in second["error"] or "not an image" in second["error"]
    assert third["instruction"] == "third"


def test_the_samples_of_a_batch_overlap_and_keep_their_given_parts(serve: Serve, photo: bytes) -> None:
    call = serve(scripted_agent(seconds=0.2, concurrency=8))
    image = base64.b64encode(photo).decode()
    samples = [
        {"image": image, "instruction": "open", "part": f"part {i}"}
        if i % 2
        else {"image": image, "instruction": "open"}
        for i in range(6)
    ]
    started = time.monotonic()
    found = call("POST", BATCH, {"samples": samples}).json["affordances"]
    assert time.monotonic() - started < 2.0  # 15 calls of 0.2 s: 3 s one after the other
    parts = [affordance["target"]["object_part"] for affordance in found]
    assert parts == [
        "the handle of the thing",
        "part 1",
        "the handle of the thing",
        "part 3",
        "the handle of the thing",
        "part 5",
    ]


def test_a_models_bad_answer_is_a_status_not_an_http_error(serve: Serve, photo: bytes) -> None:
    vlm = ScriptedVLM(lambda request: UnreadableAnswer("it wrote a poem"))
    agent = A4Agent(None, Thinker(vlm), Spotter(ScriptedDetector(), ScriptedSegmenter()))
    answer = serve(agent).ask(photo)
    assert answer.code == 200
    assert answer.json["status"] == "invalid"
    assert "poem" in answer.json["error"]


def test_a_score_that_is_not_a_number_does_not_break_the_json(serve: Serve, photo: bytes) -> None:
    from a4agent.types import Detection

    detector = ScriptedDetector(
        lambda request: Detection(np.array([[10, 10, 50, 50]], np.float32), scores=np.array([np.nan], np.float32))
    )
    agent = A4Agent(None, None, Spotter(detector, ScriptedSegmenter()))
    assert serve(agent).ask(photo).json["regions"][0]["score"] is None


@pytest.mark.parametrize(
    ("change", "code", "words"),
    [
        ({"image": "http://10.0.0.1/secret.png"}, 422, "fetches no URLs"),
        ({"image": "file:///etc/passwd"}, 422, "fetches no URLs"),
        ({"image": "not base64!"}, 422, "not base64"),
        ({"image": ""}, 422, "image"),
        ({"image": base64.b64encode(b"GIF89a but no").decode()}, 422, "image"),
        ({"image": base64.b64encode(png_claiming(60000, 60000)).decode()}, 413, "pixels"),
        ({"image": base64.b64encode(png_claiming(1200, 1000)).decode()}, 413, "send it smaller"),
        ({"image": base64.b64encode(png_claiming(500, 400)).decode()}, 422, "damaged or cut off"),
        ({"instruction": "   "}, 422, "instruction"),
        ({"instruction": "x" * 3000}, 422, "instruction"),
        ({"instruction": 7}, 422, "instruction"),
        ({"instrution": "open"}, 422, "instrution"),
    ],
)
def test_what_cannot_be_answered_is_a_clear_4xx(
    serve: Serve, photo: bytes, change: dict[str, Any], code: int, words: str
) -> None:
    answer = serve().ask(**{"image": photo, **change}) if "image" not in change else _raw(serve(), change)
    assert answer.code == code
    assert words in answer.json["error"]


def _raw(call: Any, change: dict[str, Any]) -> Any:
    return call("POST", ONE, {"instruction": "open", **change})


def test_a_data_uri_is_bytes_not_an_address(serve: Serve, photo: bytes) -> None:
    text = "data:image/jpeg;base64," + base64.b64encode(photo).decode()
    assert _raw(serve(), {"image": text}).code == 200


@pytest.mark.parametrize("part", [0.02, 0.5, 0.98])
def test_a_photo_cut_off_anywhere_is_refused_also_as_a_stream(serve: Serve, photo: bytes, part: float) -> None:
    cut = photo[: int(len(photo) * part)]
    call = serve()
    for path in (ONE, f"{ONE}?stream=1"):
        answer = call.ask(cut, path)
        assert answer.code == 422, part
        assert answer.json["error"].startswith("image: ")


def test_invalid_bodies_are_refused(serve: Serve, photo: bytes) -> None:
    call = serve()
    as_json = {"Content-Type": "application/json"}
    assert call("POST", ONE, b"{", headers=as_json).code == 400
    assert call("POST", ONE, b"[" * 100_000, headers=as_json).code == 400
    assert call("POST", ONE, b"\xff\xfe{}", headers=as_json).code == 400
    assert call("POST", ONE, b"[1]", headers=as_json).code == 422
    assert call("POST", ONE, photo, headers={"Content-Type": "image/jpeg"}).code == 415
    assert call("POST", BATCH, photo, headers={"Content-Type": "image/jpeg"}).code == 415
    assert call("POST", BATCH, {"samples": []}).code == 422
    body, headers = form(photo)
    assert call("POST", ONE, body, headers=headers).code == 422  # no instruction
    body, headers = form(photo, filename=None, instruction="open")
    assert call("POST", ONE, body, headers=headers).code in (400, 422)  # a text field, not a file
    body, headers = form(photo, instruction="open", colour="red")
    assert "colour" in call("POST", ONE, body, headers=headers).json["error"]
    assert call("POST", ONE, body[:-40], headers={"Content-Type": "multipart/form-data"}).code == 400
    assert call("GET", ONE).code == 405
    assert call("GET", "/nothing").json == {"error": "Not Found"}
    assert call.ask(photo).code == 200


def test_too_many_bytes_are_refused_however_they_come(serve: Serve, photo: bytes) -> None:
    call = serve(limits=SMALL)
    said = call("POST", ONE, bytes(200_000), headers={"Content-Type": "application/json"})
    chunked = call("POST", ONE, (bytes(1000) for _ in range(200)), headers={"Content-Type": "application/json"})
    for answer in (said, chunked):
        assert answer.code == 413
        assert "65536" in answer.json["error"]
    assert call.ask(photo).code == 200
    assert call("POST", BATCH, {"samples": [{"image": "", "instruction": "x"}] * 3}).code == 422


def test_an_upload_that_does_not_end_is_timed_out(serve: Serve) -> None:
    call = serve(limits=SMALL)
    host, port = call.address.split(":")
    with socket.create_connection((host, int(port)), timeout=10) as slow:
        head = f"POST {ONE} HTTP/1.1\r\nHost: {call.address}\r\nContent-Type: application/json\r\n"
        head += "Content-Length: 1000\r\n\r\n"
        slow.sendall(head.encode() + b"{")
        assert slow.recv(100).startswith(b"HTTP/1.1 408")


def test_a_full_queue_is_a_503_that_says_when_to_come_back(serve: Serve, photo: bytes) -> None:
    call = serve(scripted_agent(seconds=0.1), limits=Limits(body_bytes=2**20, queue=1))
    answers: list[Any] = []
    threads = [threading.Thread(target=lambda: answers.append(call.ask(photo))) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    codes = sorted(answer.code for answer in answers)
    assert codes == [200, 200, 503, 503, 503, 503]
    refused = next(answer for answer in answers if answer.code == 503)
    assert int(refused.headers["retry-after"]) >= 1
    assert "queue is full" in refused.json["error"]
    assert call.ask(photo).code == 200  # every place was given back


def test_an_answer_that_takes_too_long_is_a_503_and_the_worker_goes_on(serve: Serve, photo: bytes) -> None:
    slow = ScriptedVLM(lambda request: time.sleep(0.8) or _raise(), id="scripted:slow")
    agent = A4Agent(None, Thinker(slow), Spotter(ScriptedDetector(), ScriptedSegmenter()))
    call = serve(agent, limits=Limits(seconds=0.3))
    answer = call.ask(photo)
    assert answer.code == 503
    assert "within 0.3 seconds" in answer.json["error"]
    assert int(answer.headers["retry-after"]) >= 1
    events = events_of(call.ask(photo, f"{ONE}?stream=1").body)
    assert events[-1][0] == "error"
    assert events[-1][1]["code"] == 503


def _raise() -> Any:
    return UnreadableAnswer("too late to matter")


def test_a_caller_who_leaves_stops_the_work_between_stages(serve: Serve, photo: bytes) -> None:
    detector = ScriptedDetector()
    vlm = ScriptedVLM(lambda request: time.sleep(0.4) or output("the knob"))
    call = serve(A4Agent(None, Thinker(vlm), Spotter(detector, ScriptedSegmenter())))
    text = base64.b64encode(photo).decode()
    connection = http.client.HTTPConnection(call.address)
    body = json.dumps({"image": text, "instruction": "open"}).encode()
    connection.request("POST", ONE, body, {"Content-Type": "application/json"})
    while not vlm.requests:
        time.sleep(0.01)
    connection.close()
    time.sleep(0.6)
    assert not detector.requests
    assert call.ask(photo).code == 200
    assert len(detector.requests) == 1


def test_a_missing_key_is_a_503_and_a_bug_is_a_500_with_a_sentence(
    serve: Serve, photo: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    def broken(request: Any) -> Any:
        return CredentialError("set OPENAI_API_KEY")

    agent = A4Agent(None, Thinker(ScriptedVLM(broken)), Spotter(ScriptedDetector(), ScriptedSegmenter()))
    answer = serve(agent).ask(photo)
    assert answer.code == 503
    assert "OPENAI_API_KEY" in answer.json["error"]
    assert answer.headers["retry-after"] == "60"

    class Buggy(A4Agent):
        def predict(self, *arguments: Any, **settings: Any) -> Any:
            raise ZeroDivisionError("a bug")

    spotter = Spotter(ScriptedDetector(), ScriptedSegmenter())
    call = serve(Buggy(None, None, spotter))
    for _ in range(2):  # the worker outlives it
        answer = call.ask(photo)
        assert answer.code == 500
        assert answer.json == {"error": "the server made a mistake; its log says more"}
    assert "ZeroDivisionError" in capfd.readouterr().err
    assert b'code="500"' in call("GET", "/metrics").body


def test_probes_and_metrics(serve: Serve, photo: bytes) -> None:
    call = serve()
    assert call("GET", "/healthz").json == {"status": "ok"}
    ready = call("GET", "/readyz").json
    assert ready["profile"] == "scripted"
    assert ready["workers"] == 1
    assert ready["experts"] == ["scripted:expert"]
    call.ask(photo)
    call.ask(b"")
    call("BREW", "/coffee")
    metrics = call("GET", "/metrics")
    assert metrics.headers["content-type"].startswith("text/plain")
    text = metrics.body.decode()
    assert 'a4_requests_total{code="200",method="POST",path="/v1/affordances"} 1.0' in text
    assert 'a4_requests_total{code="422",method="POST",path="/v1/affordances"} 1.0' in text
    assert 'method="other",path="other"' in text
    assert 'a4_affordances_total{status="ok"} 1.0' in text
    assert 'a4_model_call_seconds_count{role="segmenter",stage="spotter"} 1.0' in text
    assert "a4_queue_waiting 0.0" in text
    assert "drawer" not in text


def test_two_workers_work_at_once(serve: Serve, photo: bytes) -> None:
    agent = scripted_agent(seconds=0.2, concurrency=2)
    call = serve([agent, agent])
    started = time.monotonic()
    threads = [threading.Thread(target=lambda: call.ask(photo)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert time.monotonic() - started < 1.0  # three calls of 0.2 s each, twice: 1.2 s one after the other
