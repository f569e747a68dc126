"""A hub of models on the loopback: enough of its protocol for `huggingface_hub`, with faults on request.

with FakeHub({"owner/name": {"config.json": b"{}", "model.safetensors": weights}}, gated={"owner/closed"}) as hub:
    subprocess.run([...], env={**os.environ, "HF_ENDPOINT": hub.url, "HF_HUB_OFFLINE": "0"})
"""

from __future__ import annotations

import hashlib
import json
import re
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np

COMMIT = "0123456789abcdef0123456789abcdef01234567"
Repository = Mapping[str, bytes]


def safetensors(numbers: int = 1000) -> bytes:
    """A file of weights in the format's own form: one float32 tensor."""
    data = np.arange(numbers, dtype=np.float32).tobytes()
    entry = {"weight": {"dtype": "F32", "shape": [numbers], "data_offsets": [0, len(data)]}}
    header = json.dumps(entry).encode()
    return len(header).to_bytes(8, "little") + header + data


@dataclass(frozen=True)
class Sent:
    """One file that went out: from which byte on, and how many bytes."""

    path: str
    start: int
    count: int


class FakeHub:
    """Serves until the `with` block ends.

    `cuts` lists after how many bytes the next downloads of weights break off.
    """

    def __init__(self, repositories: Mapping[str, Repository], gated: frozenset[str] | set[str] = frozenset()) -> None:
        self.repositories = dict(repositories)
        self.gated = gated
        self.cuts: list[int] = []
        self.sent: list[Sent] = []
        self.asked: list[str] = []
        handler = type("Handler", (_Handler,), {"hub": self})
        self._http = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        self._http.daemon_threads = True
        threading.Thread(target=self._http.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._http.server_port}"

    def __enter__(self) -> FakeHub:
        return self

    def __exit__(self, *_: Any) -> None:
        self._http.shutdown()
        self._http.server_close()


def _is_large(path: str) -> bool:
    return path.endswith((".safetensors", ".bin"))


def _digest(path: str, data: bytes) -> str:
    """The name under which the cache keeps a file: sha256 of large ones, git's sha1 of others."""
    if _is_large(path):
        return hashlib.sha256(data).hexdigest()
    return hashlib.sha1(f"blob {len(data)}\0".encode() + data).hexdigest()


class _Handler(BaseHTTPRequestHandler):
    hub: FakeHub
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        self._serve()

    def do_HEAD(self) -> None:
        self._serve()

    def log_message(self, *_: Any) -> None:
        """Keep the test's output clean."""

    def _serve(self) -> None:
        path = self.path.partition("?")[0]
        self.hub.asked.append(f"{self.command} {path}")
        if api := re.fullmatch(r"/api/models/([^/]+/[^/]+)(?:/(revision|tree|auth-check)(?:/([^/]+))?)?", path):
            self._serve_api(*api.groups())
        elif file := re.fullmatch(r"/([^/]+/[^/]+)/resolve/([^/]+)/(.+)", path):
            self._serve_file(*file.groups())
        else:
            self._refuse(404, "EntryNotFound")

    def _serve_api(self, name: str, what: str | None, revision: str | None) -> None:
        files = self.hub.repositories.get(name)
        if files is None:
            self._refuse(401, "RepoNotFound")
        elif revision not in (None, "main", COMMIT):
            self._refuse(404, "RevisionNotFound")
        elif what == "auth-check":
            self._refuse(403, "GatedRepo") if name in self.hub.gated else self._send(b"{}")
        elif what == "tree":
            self._send(json.dumps([self._row(path, data) for path, data in files.items()]).encode())
        else:
            gated = "manual" if name in self.hub.gated else False
            siblings = [{"rfilename": path} for path in files]
            self._send(json.dumps({"id": name, "sha": COMMIT, "gated": gated, "siblings": siblings}).encode())

    def _row(self, path: str, data: bytes) -> dict[str, Any]:
        row: dict[str, Any] = {"type": "file", "path": path, "size": len(data), "oid": "a" * 40}
        if _is_large(path):
            row["lfs"] = {"oid": _digest(path, data), "size": len(data), "pointerSize": 134}
        else:
            row["oid"] = _digest(path, data)
        return row

    def _serve_file(self, name: str, revision: str, path: str) -> None:
        files = self.hub.repositories.get(name)
        if files is None:
            return self._refuse(401, "RepoNotFound")
        if name in self.hub.gated:
            return self._refuse(403, "GatedRepo")
        if path not in files:
            return self._refuse(404, "EntryNotFound")
        data = files[path]
        asked = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range") or "")
        start = int(asked[1]) if asked else 0
        body = data[start : int(asked[2]) + 1 if asked and asked[2] else None]
        headers = {
            "ETag": f'"{_digest(path, data)}"',
            "X-Repo-Commit": COMMIT,
            "X-Linked-Size": str(len(data)),
            "Accept-Ranges": "bytes",
        }
        if asked:
            headers["Content-Range"] = f"bytes {start}-{start + len(body) - 1}/{len(data)}"
        cut = self.hub.cuts.pop(0) if self.hub.cuts and self.command == "GET" and _is_large(path) else None
        if self.command == "GET":
            self.hub.sent.append(Sent(path, start, len(body) if cut is None else min(cut, len(body))))
        self._send(body, 206 if asked else 200, headers, cut)
        return None

    def _refuse(self, code: int, error: str) -> None:
        self._send(b"{}", code, {"X-Error-Code": error, "X-Error-Message": error})

    def _send(
        self, body: bytes, code: int = 200, headers: Mapping[str, str] | None = None, cut: int | None = None
    ) -> None:
        self.send_response(code)
        for key, value in {"Content-Length": str(len(body)), **(headers or {})}.items():
            self.send_header(key, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body if cut is None else body[:cut])
            self.wfile.flush()
        if cut is not None:
            self.close_connection = True
