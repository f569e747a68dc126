"""A client for `a4 serve` in one file: Python 3.8 or later and its standard library. Copy it to the robot.

    client = Client("http://127.0.0.1:8000", token=None)
    affordance = client.predict("mug.jpg", "drink from the mug")
    if affordance.status == "ok":
        print(affordance.target.object_part, affordance.points_xy, affordance.mask.contains(440, 251))

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
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

if TYPE_CHECKING:
    Box = tuple[float, float, float, float]
    Point = tuple[float, float]

__all__ = ["Affordance", "Client", "Mask", "Region", "ServerError", "Target"]


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
class Affordance:
    """The answer.

    `status` is "ok", "abstained" (the mask is a guess: not certain enough), "empty" (nothing found), "invalid" (a
    model's answer was unusable) or "error". `confidence` is the probability (0 to 1) that the mask is right, None where
    the server has no Verifier; `checks` are what it looked at, dicts with "name", "value", "note" and "blame".
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
        target = data["target"]
        return cls(
            instruction=data["instruction"],
            size_wh=(width, height),
            status=data["status"],
            error=data["error"],
            target=_target(target) if target else None,
            regions=tuple(_region(row, data["mask"]) for row in data["regions"]),
            mask=_mask(data["mask"]),
            trace=tuple(data["trace"]),
            id=data.get("id", ""),
            confidence=data["confidence"],
            checks=tuple(data["checks"]),
            json=data,
        )


class Client:
    """Calls one server. Not thread-safe: give each thread its own.

    Args:
        url: where the server is; http or https.
        token: its bearer token, if it has one.
        timeout: seconds for one answer.
        retries: how often to try again after a busy server (503) or a broken connection.
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

    def predict(self, image: Any, instruction: str, part: str | None = None) -> Affordance:
        """Where to act for `instruction`; if the `part` is known already, only where it is.

        Raises:
            ServerError: the question was refused, or the server stayed busy or away.
        """
        body, kind = _form(image, instruction, part)
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
        body, kind = _form(image, instruction, part)
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
                if left <= 0 or not error.retryable:
                    raise
                pause = wait if error.retry_after is None else error.retry_after
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


def encode_png(width: int, height: int, rgb: bytes) -> bytes:
    """An RGB PNG of raw pixels, row by row, three bytes each."""
    rows = b"".join(b"\0" + rgb[start : start + 3 * width] for start in range(0, 3 * width * height, 3 * width))

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
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


def _form(image: Any, instruction: str, part: str | None) -> tuple[bytes, str]:
    data = _file_of(image)
    boundary = f"a4-{zlib.crc32(data):08x}{zlib.adler32(data):08x}"
    while boundary.encode() in data:
        boundary += "x"
    body = b""
    for name, text in (("instruction", instruction), ("part", part)):
        if text is not None:
            head = f'--{boundary}\r\nContent-Disposition: form-data; name="{name}"\r\n\r\n'
            body += head.encode() + text.encode("utf-8") + b"\r\n"
    head = f'--{boundary}\r\nContent-Disposition: form-data; name="image"; filename="image"\r\n\r\n'
    body += head.encode() + data + f"\r\n--{boundary}--\r\n".encode()
    return body, "multipart/form-data; boundary=" + boundary


def _target(row: dict[str, Any]) -> Target:
    return Target(row["task"], row["object_name"], row["object_part"], row.get("thinking", ""))


def _region(row: dict[str, Any], union: dict[str, Any]) -> Region:
    """A region; the mask of a single one is sent as the answer's."""
    box = row["box_xyxy"]
    return Region(
        box_xyxy=None if box is None else (box[0], box[1], box[2], box[3]),
        points_xy=tuple((point[0], point[1]) for point in row["points_xy"]),
        mask=_mask(row["mask"] or union),
        score=row["score"],
    )


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
