"""The client against a real server, from the oldest Python on this machine and from this one."""

from __future__ import annotations

import io
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from PIL import Image

from a4agent import client
from a4agent import types as core
from a4agent.client import Client, ServerError
from a4agent.imaging.masks import encode_rle
from a4agent.serve import http_server
from a4agent.serve.admission import Limits
from a4agent.serve.api import create_app
from a4agent.testing import scripted_agent

FILE = Path(client.__file__)
TOKEN = "a-token-of-some-length"


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    app = create_app([scripted_agent(dream=True)], token=TOKEN, limits=Limits(queue=32))
    with http_server.in_thread(app) as url:
        yield url


@pytest.fixture(scope="module")
def photo() -> bytes:
    file = io.BytesIO()
    Image.radial_gradient("L").resize((160, 120)).convert("RGB").save(file, "JPEG")
    return file.getvalue()


def oldest_python() -> str | None:
    """The oldest Python from 3.8 on that this machine has: on the path, or where pyenv keeps them."""
    roots = [Path(os.environ.get("PYENV_ROOT", "~/.pyenv")).expanduser(), Path("/root/.pyenv")]
    for minor in range(8, sys.version_info.minor):
        homes = [home for root in roots for home in sorted(root.glob(f"versions/3.{minor}.*/bin/python"))]
        for python in [shutil.which(f"python3.{minor}"), *map(str, homes)]:
            if python and subprocess.run([python, "-c", "import ssl, zlib"], capture_output=True).returncode == 0:
                return python
    return None


SCRIPT = """
import sys
from client import Client, ServerError
url, token, photo = sys.argv[1:]
client = Client(url, token)
assert client.ready()
found = client.predict(photo, "open the drawer")
assert found.status == "ok" and found.size_wh == (160, 120), found
assert found.target.object_part == "the handle of the thing"
assert found.boxes_xyxy == [(40, 30, 120, 90)] and found.points_xy == [(80, 60)]
assert found.mask.area == 80 * 60 == sum(found.mask.to_bytes())
assert found.mask.contains(40, 30) and not found.mask.contains(120, 60) and not found.mask.contains(-1, 5)
names = [name for name, _ in client.stream(photo, "open the drawer")]
assert names == ["queued", "imagination", "target", "detection", "affordance"], names
assert [a.status for a in client.predict_many([(photo, "one"), (b"no picture", "two")])] == ["ok", "error"]
try:
    client.predict(b"no picture", "x")
except ServerError as error:
    assert error.status == 422 and "image" in str(error)
else:
    raise AssertionError("not refused")
print(sys.version_info[:2], sorted(set(sys.modules) & {"numpy", "PIL", "a4agent"}))
"""


def test_one_file_copied_to_the_oldest_python_is_enough(url: str, photo: bytes, tmp_path: Path) -> None:
    python = oldest_python() or sys.executable
    shutil.copy(FILE, tmp_path / "client.py")
    (tmp_path / "photo.jpg").write_bytes(photo)
    (tmp_path / "robot.py").write_text(SCRIPT)
    command = [
        python,
        "-I",
        "-W",
        "error",
        "-c",
        "import sys; sys.path.insert(0, '.'); sys.argv.pop(0); exec(open('robot.py').read())",
    ]
    done = subprocess.run([*command, "robot", url, TOKEN, "photo.jpg"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    version, _, others = done.stdout.strip().partition(") ")
    assert others == "[]"
    assert version.startswith("(3")


def test_the_file_needs_nothing_but_the_standard_library() -> None:
    import ast

    tree = ast.parse(FILE.read_text(encoding="utf-8"), feature_version=(3, 8))
    names = {
        name.name.partition(".")[0] for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names
    }
    names |= {
        node.module.partition(".")[0] for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module
    }
    assert names - set(sys.stdlib_module_names) == {"numpy"}  # inside Mask.to_numpy, for those who have it


@given(arrays.arrays(bool, st.tuples(st.integers(1, 12), st.integers(1, 12))))
def test_masks_unpack_as_they_were_packed(mask: np.ndarray) -> None:
    packed = encode_rle(mask)
    read = client.Mask(*packed["size"], packed["counts"])
    assert (read.to_numpy() == mask).all()
    assert read.area == mask.sum()
    rows, columns = np.nonzero(mask)
    assert all(read.contains(x + 0.5, y) for x, y in zip(columns, rows, strict=True))
    assert sum(read.contains(x, y) for x in range(-1, 13) for y in range(-1, 13)) == mask.sum()


def test_large_masks_with_long_runs_too() -> None:
    mask = np.zeros((900, 1300), bool)
    mask[100:700, 200:1100] = True
    mask[300:302, 400:402] = False
    packed = encode_rle(mask)
    assert (client.Mask(*packed["size"], packed["counts"]).to_numpy() == mask).all()


def test_an_array_is_sent_unchanged(url: str) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (30, 50, 3), np.uint8)
    png = client.encode_png(50, 30, pixels.tobytes())
    assert (np.asarray(Image.open(io.BytesIO(png))) == pixels).all()
    assert Client(url, TOKEN).predict(pixels, "open").size_wh == (50, 30)
    with pytest.raises(TypeError, match="uint8"):
        Client(url, TOKEN).predict(pixels.astype(float), "open")


def test_contacts_come_in_pixels_and_with_depth_in_metres(url: str, photo: bytes, tmp_path: Path) -> None:
    camera = {"fx": 200.0, "fy": 200.0, "cx": 79.5, "cy": 59.5}
    metres = np.full((120, 160), 0.7)
    metres[0, 0] = np.nan
    millimetres = np.nan_to_num(metres * 1000).astype(np.uint16)
    Image.fromarray(millimetres).save(tmp_path / "depth.png")
    asked = Client(url, TOKEN)
    without = asked.predict(photo, "open")
    assert without.contacts[0].position_xyz is None
    assert without.mask.contains(*without.contacts[0].point_xy)
    assert without.grasps == ()
    assert "depth" in without.no_grasps
    for depth in (metres, millimetres, tmp_path / "depth.png", (tmp_path / "depth.png").read_bytes()):
        (contact, *_) = asked.predict(photo, "open", depth=depth, camera=camera).contacts
        assert contact.position_xyz is not None
        assert contact.position_xyz[2] == pytest.approx(0.7, abs=1e-3)
    micrometres = asked.predict(photo, "open", depth=millimetres * 10, camera=camera, depth_scale=1e-4)
    assert micrometres.contacts == asked.predict(photo, "open", depth=millimetres, camera=camera).contacts
    with pytest.raises(ServerError, match="camera: it is needed"):
        asked.predict(photo, "open", depth=metres)
    with pytest.raises(TypeError, match="float metres"):
        asked.predict(photo, "open", depth=metres[0])


def test_the_same_attributes_as_the_librarys_own(url: str, photo: bytes) -> None:
    theirs = Client(url, TOKEN).predict(photo, "öffne die Schublade", part="the knob")
    ours = core.Affordance.from_dict(theirs.to_dict())
    assert theirs.instruction == ours.instruction == "öffne die Schublade"
    assert theirs.target is not None
    assert theirs.target.object_part == "the knob"
    assert np.array(theirs.boxes_xyxy) == pytest.approx(ours.boxes_xyxy)
    assert np.array(theirs.points_xy) == pytest.approx(ours.points_xy)
    assert (theirs.mask.to_numpy() == ours.mask).all()
    assert (theirs.regions[0].mask.to_numpy() == ours.regions[0].mask).all()
    public = {name for name in vars(core.Affordance) if not name.startswith("_")} & {"boxes_xyxy", "points_xy", "mask"}
    assert public <= set(dir(theirs))


def test_a_wrong_token_is_not_tried_again(url: str, photo: bytes) -> None:
    with pytest.raises(ServerError, match="token") as caught:
        Client(url, "wrong", retries=50).predict(photo, "open")
    assert caught.value.status == 401
    assert Client(url, "wrong").ready()  # the probe is open


def test_a_busy_server_is_asked_again_when_it_says(photo: bytes) -> None:
    app = create_app([scripted_agent(seconds=0.2)], limits=Limits(queue=0))
    with http_server.in_thread(app) as url:
        found: list[client.Affordance] = []
        threads = [threading.Thread(target=lambda: found.append(Client(url).predict(photo, "open"))) for _ in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert [affordance.status for affordance in found] == ["ok", "ok"]
        busy = threading.Thread(target=lambda: Client(url).predict(photo, "open"))
        busy.start()
        time.sleep(0.1)
        with pytest.raises(ServerError, match="queue is full") as caught:
            Client(url, retries=0).predict(photo, "open")
        busy.join()
        assert caught.value.status == 503
        assert caught.value.retry_after is not None


@pytest.mark.parametrize(
    ("header", "seconds"),
    [("2.5", 2.5), ("0", 0.0), (None, None), ("soon", None), ("nan", None), ("inf", None), ("-1", None)],
)
def test_only_a_number_of_seconds_is_waited_for(header: str | None, seconds: float | None) -> None:
    assert client._seconds(header) == seconds


def test_a_pause_longer_than_the_timeout_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    pauses: list[float] = []
    busy = Client(timeout=5.0)

    def ask(method: str, path: str, body: bytes | None, kind: str) -> Any:
        raise ServerError("busy", 503, 2.0 if not pauses else 1e9, retryable=True)

    monkeypatch.setattr(busy, "_ask", ask)
    monkeypatch.setattr(client.time, "sleep", pauses.append)
    with pytest.raises(ServerError, match="busy"):
        busy.predict(b"", "open")
    assert pauses == [2.0]


def test_a_server_that_is_away_comes_back() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    away = Client(f"http://127.0.0.1:{port}", retries=1)
    assert not away.ready()
    with pytest.raises(ServerError, match="cannot be reached") as caught:
        away.predict(b"", "open")
    assert caught.value.status == 0


@pytest.mark.parametrize("cut", ["", 'event: affordance\ndata: {"schema"'])
def test_a_stream_that_breaks_is_an_error_not_an_end(cut: str, photo: bytes) -> None:
    def half(listener: socket.socket) -> None:
        connection, _ = listener.accept()
        connection.recv(100_000)
        connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\nConnection: close\r\n\r\n")
        connection.sendall(b'event: queued\ndata: {"position":0}\n\n' + cut.encode())
        connection.close()

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=half, args=(listener,)).start()
        stream = Client(f"http://127.0.0.1:{listener.getsockname()[1]}").stream(photo, "open")
        assert next(stream) == ("queued", {"position": 0})
        with pytest.raises(ServerError, match=r"ended the stream|broke"):
            next(stream)


def test_a_timeout_is_not_retried(photo: bytes) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        started = time.monotonic()
        with pytest.raises(ServerError, match="no answer within"):
            Client(f"http://127.0.0.1:{silent.getsockname()[1]}", timeout=0.3, retries=5).predict(photo, "open")
        assert time.monotonic() - started < 2


def test_an_invalid_url_is_refused() -> None:
    with pytest.raises(ValueError, match="http://127"):
        Client("robot.local:8000")
    with pytest.raises(ValueError, match="Port"):
        Client("http://robot.local:99999")


def test_a_token_read_from_a_file_may_end_its_line(url: str, photo: bytes) -> None:
    assert Client(url, TOKEN + "\n").predict(photo, "open").status == "ok"


def test_a_newer_server_may_say_more_of_the_target(url: str, photo: bytes) -> None:
    data = Client(url, TOKEN).predict(photo, "open").to_dict()
    more = {**data, "target": {**data["target"], "mood": "glad"}}
    assert client.Affordance.from_dict(more).target == client.Affordance.from_dict(data).target
