"""A client for `a4 serve` in one file: Python 3.8 or later and its standard library. Copy it to the robot.

    client = Client("http://127.0.0.1:8000", token=None)
    affordance = client.predict("mug.jpg", "drink from the mug")
    if affordance.status == "ok":
        print(affordance.target.object_part, affordance.points_xy, affordance.mask.contains(440, 251))
        print(affordance.contacts[0].point_xy)      # where to touch it

    camera = {"fx": 600, "fy": 600, "cx": 319.5, "cy": 239.5}
    affordance = client.predict("mug.jpg", "drink from the mug", depth="mug-depth.png", camera=camera)
    print(affordance.contacts[0].position_xyz, affordance.grasps[:1])   # in metres

    for name, value in client.stream("mug.jpg", "drink from the mug"):   # as the stages finish
        print(name, value)

A picture is a path, the bytes of an image file, or a uint8 array (H, W, 3) in RGB, numpy's or another's. Answers have
the shape of `a4agent.Affordance`: pixels of the upright picture, x right, y down; boxes half-open. A busy server is
asked again after the time it names, a broken connection after a moment; other failures raise `ServerError`.
"""

from __future__ import annotations

import base64
import http.client
import json
import math
import socket
import ssl
import struct
import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

if TYPE_CHECKING:
    Box = tuple[float, float, float, float]
    Point = tuple[float, float]
    Vector = tuple[float, float, float]

__all__ = ["Affordance", "Client", "Contact", "Grasp", "Mask", "Region", "ServerError", "Target"]


class ServerError(Exception):
    """The server refused the question, or did not answer it.

    `status` is the HTTP status, 0 if there was none; `retryable` says whether the same question may succeed later.
    """

    def __init__(
        self, message: str, status: int = 0, retry_after: float | None = None, retryable: bool = False
    ) -> None:
        super().__init__(message)
        self.status = status
        self.retry_after = retry_after
        self.retryable = retryable


@dataclass(frozen=True)
class Mask:
    """A mask (height, width) as COCO run-length encoding; unpacked when it is asked for."""

    height: int
    width: int
    counts: str

    def runs(self) -> list[int]:
        """Lengths of the runs, down the columns, in turn of 0 and of 1, beginning with 0."""
        lengths: list[int] = []
        value, shift = 0, 0
        for letter in self.counts:
            digit = ord(letter) - 48
            value |= (digit & 0x1F) << shift
            shift += 5
            if digit & 0x20:  # more digits follow
                continue
            if digit & 0x10:  # the number is negative
                value -= 1 << shift
            lengths.append(value + (lengths[-2] if len(lengths) > 2 else 0))
            value, shift = 0, 0
        return lengths

    @property
    def area(self) -> int:
        """How many pixels are set."""
        return sum(self.runs()[1::2])

    def contains(self, x: float, y: float) -> bool:
        """Whether the pixel at (x, y) is set; False outside the picture."""
        column, row = int(x // 1), int(y // 1)
        if not (0 <= column < self.width and 0 <= row < self.height):
            return False
        place, seen, value = column * self.height + row, 0, False
        for length in self.runs():
            seen += length
            if place < seen:
                return value
            value = not value
        return False

    def to_bytes(self) -> bytes:
        """One byte a pixel, 0 or 1, row by row: `numpy.frombuffer(..., bool).reshape(height, width)`."""
        columns = bytearray()
        value = 0
        for length in self.runs():
            columns += bytes([value]) * length
            value = 1 - value
        rows = bytearray(self.height * self.width)
        for row in range(self.height):
            rows[row * self.width : (row + 1) * self.width] = columns[row :: self.height]
        return bytes(rows)

    def to_numpy(self) -> Any:
        """The mask as a numpy array (height, width) of bool, where numpy is installed."""
        import numpy

        return numpy.frombuffer(self.to_bytes(), dtype=bool).reshape(self.height, self.width)


@dataclass(frozen=True)
class Target:
    """The part to act on, as the model named it, and why."""

    task: str
    object_name: str
    object_part: str
    thinking: str = ""


@dataclass(frozen=True)
class Region:
    """One part: its box or None, its key points, its mask, the model's confidence or None."""

    box_xyxy: Box | None
    points_xy: tuple[Point, ...]
    mask: Mask
    score: float | None = None


@dataclass(frozen=True)
class Contact:
    """A place to touch, in pixels; with depth also in metres in the camera's optical frame, else None.

    `clearance` is in pixels from the mask's edge; `normal_xyz` points to the camera, `approach_xyz` into the surface.
    """

    point_xy: Point
    clearance: float
    position_xyz: Vector | None
    normal_xyz: Vector | None
    approach_xyz: Vector | None
    reachable: bool
    reason: str


@dataclass(frozen=True)
class Grasp:
    """A parallel gripper's `pose` (4 rows of 4, metres): x closes, z approaches. `width` is its opening in metres."""

    pose: tuple[tuple[float, ...], ...]
    width: float
    score: float
    contacts_xy: tuple[Point, ...]


@dataclass(frozen=True)
class Affordance:
    """The answer.

    `status` is "ok", "abstained" (the mask is a guess: not certain enough), "empty" (nothing found), "invalid" (a
    model's answer was unusable) or "error". `confidence` is the probability (0 to 1) that the mask is right, None where
    the server has no Verifier; `checks` are what it looked at, dicts with "name", "value", "note" and "blame".
    `contacts` and `grasps` come best first; grasps need depth, and `no_grasps` says why there are none.
    """

    instruction: str
    size_wh: tuple[int, int]
    status: str
    error: str | None
    target: Target | None
    regions: tuple[Region, ...]
    mask: Mask
    trace: tuple[dict[str, Any], ...] = ()
    id: str = ""
    confidence: float | None = None
    checks: tuple[dict[str, Any], ...] = ()
    contacts: tuple[Contact, ...] = ()
    grasps: tuple[Grasp, ...] = ()
    no_grasps: str = ""
    json: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    @property
    def boxes_xyxy(self) -> list[Box]:
        """The boxes of the regions that have one."""
        return [region.box_xyxy for region in self.regions if region.box_xyxy is not None]

    @property
    def points_xy(self) -> list[Point]:
        """All key points."""
        return [point for region in self.regions for point in region.points_xy]

    def to_dict(self) -> dict[str, Any]:
        """What the server sent; `a4agent.Affordance.from_dict` reads it."""
        return self.json

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Affordance:
        """Read the JSON of an answer."""
        width, height = data["size_wh"]
        action: dict[str, Any] = data["action"]
        return cls(
            instruction=data["instruction"],
            size_wh=(width, height),
            status=data["status"],
            error=data["error"],
            target=_read(Target, data["target"]) if data["target"] else None,
            regions=tuple(_region(row, data["mask"]) for row in data["regions"]),
            mask=_mask(data["mask"]),
            trace=tuple(data["trace"]),
            id=data.get("id", ""),
            confidence=data["confidence"],
            checks=tuple(data["checks"]),
            contacts=tuple(_read(Contact, row) for row in action["contacts"]),
            grasps=tuple(_read(Grasp, row) for row in action["grasps"]),
            no_grasps=action["reason"],
            json=data,
        )


class Client:
    """Calls one server. Not thread-safe: give each thread its own.

    Args:
        url: where the server is; http or https.
        token: its bearer token, if it has one.
        timeout: seconds for one answer.
        retries: how often to try again after a busy server (503) or a broken connection. A server that asks for a
            longer pause than `timeout` is not asked again.
        ssl_context: for https, to trust other certificates than the system's.
    """

    def __init__(
        self,
        url: str = "http://127.0.0.1:8000",
        token: str | None = None,
        timeout: float = 330.0,
        retries: int = 3,
        ssl_context: ssl.SSLContext | None = None,
    ) -> None:
        parts = urlsplit(url)
        if parts.scheme not in ("http", "https") or not parts.hostname or parts.port == 0:  # a bad port is a ValueError
            raise ValueError(f"{url!r} is not a server's URL; use one like 'http://127.0.0.1:8000'")
        self.url = url.rstrip("/")
        self.timeout = timeout
        self.retries = retries
        self._parts = parts
        self._headers = {"Authorization": "Bearer " + token.strip()} if token else {}
        self._ssl = ssl_context

    def predict(
        self,
        image: Any,
        instruction: str,
        part: str | None = None,
        *,
        depth: Any = None,
        camera: dict[str, float] | None = None,
        depth_scale: float = 0.001,
    ) -> Affordance:
        """Where to act for `instruction`; if the `part` is known already, only where it is.

        `depth` is registered to the picture: a 16-bit PNG (path or bytes), a uint16 array (H, W) in units of
        `depth_scale` metres, or a float array in metres. `camera` has "fx", "fy", "cx" and "cy" in pixels.

        Raises:
            ServerError: the question was refused, or the server stayed busy or away.
        """
        texts = {"instruction": instruction, "part": part}
        files = {"image": _file_of(image)}
        if depth is not None:
            files["depth"], scale = _depth_file_of(depth, depth_scale)
            texts.update(camera=json.dumps(camera), depth_scale=repr(scale))
        body, kind = _form(texts, files)
        return Affordance.from_dict(self._post("/v1/affordances", body, kind))

    def predict_many(self, samples: Sequence[tuple[Any, str]]) -> list[Affordance]:
        """The answers to pairs of (image, instruction), in one request."""
        rows = [
            {"image": base64.b64encode(_file_of(image)).decode("ascii"), "instruction": instruction}
            for image, instruction in samples
        ]
        body = json.dumps({"samples": rows}).encode()
        answers = self._post("/v1/affordances/batch", body, "application/json")
        return [Affordance.from_dict(data) for data in answers["affordances"]]

    def stream(self, image: Any, instruction: str, part: str | None = None) -> Iterator[tuple[str, Any]]:
        """The events as they come: dicts for "queued", "imagination", "target", "detection"; at last "affordance".

        Raises:
            ServerError: as `predict`, also after some events.
        """
        body, kind = _form({"instruction": instruction, "part": part}, {"image": _file_of(image)})
        connection, response = self._answer("POST", "/v1/affordances?stream=1", body, kind)
        try:
            name = ""
            for line in response:
                text = line.decode("utf-8").rstrip("\n")
                if text.startswith("event: "):
                    name = text[len("event: ") :]
                elif text.startswith("data: "):
                    data = json.loads(text[len("data: ") :])
                    if name == "error":
                        raise ServerError(
                            data["error"], data["code"], data["retry_after"], retryable=data["code"] == 503
                        )
                    yield name, Affordance.from_dict(data) if name == "affordance" else data
                    if name == "affordance":
                        return
            raise ServerError(f"{self.url} ended the stream without an answer")
        except (OSError, http.client.HTTPException, ValueError) as error:
            raise ServerError(f"the connection to {self.url} broke: {error!r}") from error
        finally:
            connection.close()

    def ready(self) -> bool:
        """Whether the server answers questions now."""
        try:
            connection, _ = self._answer("GET", "/readyz", None, "", retries=0)
        except ServerError:
            return False
        connection.close()
        return True

    def _post(self, path: str, body: bytes, kind: str) -> dict[str, Any]:
        connection, response = self._answer("POST", path, body, kind)
        try:
            return json.loads(response.read())
        except (OSError, http.client.HTTPException, ValueError) as error:
            raise ServerError(f"the answer of {self.url} was cut off: {error!r}") from error
        finally:
            connection.close()

    def _answer(
        self, method: str, path: str, body: bytes | None, kind: str, retries: int | None = None
    ) -> tuple[http.client.HTTPConnection, http.client.HTTPResponse]:
        """A connection and the beginning of a good answer; asks again where that may help."""
        left = self.retries if retries is None else retries
        wait = 0.5
        while True:
            try:
                return self._ask(method, path, body, kind)
            except ServerError as error:
                pause = wait if error.retry_after is None else error.retry_after
                if left <= 0 or not error.retryable or pause > self.timeout:
                    raise
            left, wait = left - 1, wait * 2
            time.sleep(pause)

    def _ask(
        self, method: str, path: str, body: bytes | None, kind: str
    ) -> tuple[http.client.HTTPConnection, http.client.HTTPResponse]:
        connection = self._connection()
        headers = dict(self._headers)
        if kind:
            headers["Content-Type"] = kind
        try:
            connection.request(method, self._parts.path.rstrip("/") + path, body, headers)
            response = connection.getresponse()
            if response.status == 200:
                return connection, response
            text = response.read().decode("utf-8", "replace")
        except (OSError, http.client.HTTPException) as error:
            connection.close()
            if isinstance(error, socket.timeout):
                raise ServerError(f"{self.url} gave no answer within {self.timeout:g} seconds") from error
            raise ServerError(f"{self.url} cannot be reached: {error!r}", retryable=True) from error
        connection.close()
        status, after = response.status, _seconds(response.getheader("Retry-After"))
        raise ServerError(_sentence(text, status), status, after, retryable=status == 503)

    def _connection(self) -> http.client.HTTPConnection:
        host, port = self._parts.hostname or "", self._parts.port
        if self._parts.scheme == "https":
            return http.client.HTTPSConnection(host, port, timeout=self.timeout, context=self._ssl)
        return http.client.HTTPConnection(host, port, timeout=self.timeout)


def encode_png(width: int, height: int, pixels: bytes, deep: bool = False) -> bytes:
    """A PNG of raw pixels, row by row: three bytes of RGB each, or two of `deep` grey, the higher first."""
    length = (2 if deep else 3) * width
    rows = b"".join(b"\0" + pixels[start : start + length] for start in range(0, length * height, length))

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = struct.pack(">IIBBBBB", width, height, 16 if deep else 8, 0 if deep else 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows, 1)) + chunk(b"IEND", b"")


def _file_of(image: Any) -> bytes:
    if isinstance(image, (bytes, bytearray, memoryview)):
        return bytes(image)
    if isinstance(image, (str, Path)):
        return Path(image).read_bytes()
    shape = tuple(getattr(image, "shape", ()))
    if len(shape) != 3 or shape[2] != 3 or str(getattr(image, "dtype", "")) != "uint8":
        raise TypeError(f"an image is a path, bytes or a uint8 array (H, W, 3), not {type(image).__name__}")
    return encode_png(shape[1], shape[0], image.tobytes())


def _depth_file_of(depth: Any, scale: float) -> tuple[bytes, float]:
    """A depth image as a 16-bit PNG, and its metres per unit."""
    if isinstance(depth, (bytes, bytearray, memoryview, str, Path)):
        return _file_of(depth), scale
    import numpy

    values = numpy.asarray(depth)
    if values.ndim != 2 or values.dtype.kind not in "fu":
        raise TypeError(f"depth is (H, W) of uint16 or of float metres, not {values.shape} of {values.dtype}")
    if values.dtype.kind == "f":
        values, scale = numpy.nan_to_num(values, posinf=0, neginf=0) * 1000, 0.001
    whole = values.round().clip(0, 65535).astype(">u2")
    return encode_png(whole.shape[1], whole.shape[0], whole.tobytes(), deep=True), scale


def _form(texts: dict[str, str | None], files: dict[str, bytes]) -> tuple[bytes, str]:
    boundary = "a4-" + "".join(f"{zlib.crc32(data):08x}{zlib.adler32(data):08x}" for data in files.values())
    while any(boundary.encode() in data for data in files.values()):
        boundary += "x"
    body = b""
    for name, text in texts.items():
        if text is not None:
            head = f'--{boundary}\r\nContent-Disposition: form-data; name="{name}"\r\n\r\n'
            body += head.encode() + text.encode("utf-8") + b"\r\n"
    for name, data in files.items():
        head = f'--{boundary}\r\nContent-Disposition: form-data; name="{name}"; filename="{name}"\r\n\r\n'
        body += head.encode() + data + b"\r\n"
    return body + f"--{boundary}--\r\n".encode(), "multipart/form-data; boundary=" + boundary


def _region(row: dict[str, Any], union: dict[str, Any]) -> Region:
    """A region; the mask of a single one is sent as the answer's."""
    return Region(_tuples(row["box_xyxy"]), _tuples(row["points_xy"]), _mask(row["mask"] or union), row["score"])


def _read(kind: Any, row: dict[str, Any]) -> Any:
    """A dataclass from the fields of a JSON object, with tuples for lists."""
    return kind(**{one.name: _tuples(row[one.name]) for one in fields(kind)})


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _mask(rle: dict[str, Any]) -> Mask:
    return Mask(rle["size"][0], rle["size"][1], rle["counts"])


def _sentence(text: str, status: int) -> str:
    try:
        return str(json.loads(text)["error"])
    except (ValueError, KeyError, TypeError):
        return f"the server answered {status}: {text[:200]}"


def _seconds(text: str | None) -> float | None:
    """The pause that a Retry-After asks for; None for a date or an invalid number."""
    try:
        seconds = float(text or "")
    except ValueError:
        return None
    return seconds if 0 <= seconds < math.inf else None
