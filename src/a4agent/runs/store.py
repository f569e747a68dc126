"""A run is a folder. Its process may be killed at any moment; the next one continues where it stopped.

    runs/umd-paper-1f0c3a9e/
      manifest.json      the configuration; a folder never changes it (see manifest.py)
      samples.jsonl      one line per scored sample, on disk before the next one is scored
      images/4be1….jpg   the pictures of the samples, named by the hash of their pixels, scaled down for display
      images/90c3….webp  what an answer led to, as an animation, where a benchmark acts on answers
      scores.json        the scores when the last session ended; computed from samples.jsonl, safe to delete
      lock               held while a process writes

A line of samples.jsonl (wrapped here) is `Affordance.to_dict()` with its score:

    {"schema": 2, "id": "mug_02", "instruction": "...", "size_wh": [640, 480], "status": "ok", "error": null,
     "confidence": 0.91, "checks": [...], "target": {...}, "imagination": null, "boxes_xyxy": [...], "points_xy": [...],
     "mask": {"size": ..., "counts": ...}, "regions": [...], "trace": [...],
     "intersection": 2041, "union": 2517, "iou": 0.8109, "truth_pixels": 2230, "prediction_pixels": 2328,
     "truth": {"size": ..., "counts": ...}, "resized": false, "measures": {"contact": 1.0}, "category": "grasp",
     "tags": {}, "pictures": {"original": "images/4be1….jpg"}}

A sample that is asked for again gets a second line; the last line of an id counts. An unfinished last line is ignored
by readers and cut off by the next writer.
"""

from __future__ import annotations

import hashlib
import json
import os
import socket
import sys
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image as Pillow
from PIL.Image import Image

from a4agent.errors import ConfigError, DataError
from a4agent.files import is_draft, replace_file
from a4agent.imaging.encode import encoded
from a4agent.imaging.load import image_hash
from a4agent.metrics import Row
from a4agent.redaction import redact
from a4agent.runs.line import problem_of
from a4agent.runs.manifest import Manifest, differences
from a4agent.types import Affordance, Status

PICTURE_SIDE = 768
SCORED = ("id", "status", "intersection", "union", "truth_pixels", "prediction_pixels", "category", "resized")
"""The fields that a writer keeps in memory; masks and traces stay on disk."""
STATUSES: tuple[Status, ...] = ("ok", "abstained", "empty", "invalid", "error")


@dataclass(frozen=True, eq=False)
class Record:
    """One line of samples.jsonl."""

    row: Mapping[str, Any]

    @property
    def id(self) -> str:
        return self.row["id"]

    @property
    def status(self) -> Status:
        return self.row["status"]

    @property
    def scored(self) -> Row:
        """The row for the metrics."""
        row = self.row
        return Row(
            row["intersection"],
            row["union"],
            row["status"],
            row.get("truth_pixels"),
            row.get("prediction_pixels"),
            bool(row.get("resized")),
        )

    @property
    def confidence(self) -> float | None:
        """The Verifier's probability that the mask is right; None without a Verifier."""
        return self.row.get("confidence")

    @property
    def measures(self) -> Mapping[str, float | None]:
        """Further measures of the answer by name, such as "contact"; None where one is undefined."""
        return self.row.get("measures") or {}

    @property
    def iou(self) -> float:
        """By the strict protocol: 1 if truth and prediction are both empty, 0 for a failed sample."""
        scored = self.scored
        return scored.intersection / scored.union if scored.union else float(not scored.failed)

    @property
    def category(self) -> str:
        return self.row.get("category") or ""

    @property
    def tags(self) -> Mapping[str, str]:
        """Further groups to score by."""
        return self.row.get("tags") or {}

    @property
    def truth(self) -> Mapping[str, Any]:
        """The true mask as COCO RLE; the one closest to the answer where several are right."""
        return self.row["truth"]

    @property
    def pictures(self) -> Mapping[str, str]:
        """ "original" and "imagination": paths below the run folder."""
        return self.row.get("pictures") or {}

    @property
    def affordance(self) -> Affordance:
        """The answer itself, without its pictures."""
        return Affordance.from_dict(self.row)

    @property
    def seconds(self) -> float:
        return sum(step.get("seconds") or 0.0 for step in self.row["trace"])

    @property
    def cost(self) -> float:
        """US dollars spent on answers that did not come from the cache."""
        return sum(step.get("cost") or 0.0 for step in self.row["trace"] if not step.get("cached"))


@dataclass(frozen=True, eq=False)
class Run:
    """A run on disk: `records` by id, the last of each."""

    folder: Path
    manifest: Manifest
    records: Mapping[str, Record]

    @property
    def planned(self) -> int:
        """How many samples the complete run has."""
        return int(self.manifest.identity["selection"]["samples"])

    @property
    def external(self) -> bool:
        """Whether another system wrote the masks; see `external.write_run`."""
        return "predictions" in self.manifest.identity

    @property
    def complete(self) -> bool:
        return len(self.records) >= self.planned


def read_run(folder: str | Path) -> Run:
    """Read a run; another process may still be writing it.

    Raises:
        DataError: not a run folder, or a line of it is damaged.
    """
    folder = Path(folder)
    return Run(folder, _read_manifest(folder / "manifest.json"), read_records(folder / "samples.jsonl"))


def _read_manifest(path: Path) -> Manifest:
    try:
        return Manifest.from_json(path.read_bytes(), str(path))
    except FileNotFoundError as error:
        raise DataError(
            f"{str(path.parent)!r} is not a run folder: it has no manifest.json; `a4 bench` makes one"
        ) from error
    except OSError as error:
        raise DataError(f"{str(path)!r} cannot be read: {error}") from error


def read_records(path: Path, keep: Iterable[str] = ()) -> dict[str, Record]:
    """The last record of every id, in the order of their first lines; an unfinished last line is ignored.

    `keep` names the fields wanted, all if it is empty.

    Raises:
        DataError: another line is damaged, or was written by another version.
    """
    records: dict[str, Record] = {}
    try:
        with path.open("rb") as file:
            for number, line in enumerate(file, 1):
                try:
                    row = json.loads(line)
                    problem = problem_of(row)
                except (ValueError, RecursionError) as error:
                    row, problem = {}, str(error)
                if not problem:
                    records[row["id"]] = Record({key: row[key] for key in keep if key in row} if keep else row)
                elif line.endswith(b"\n"):
                    raise DataError(
                        f"line {number} of {str(path)!r} is damaged: {problem}; remove that line and run `a4 bench`"
                        " again: it keeps the other lines and asks for this sample only"
                    )
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise DataError(f"{str(path)!r} cannot be read: {error}") from error
    return records


class RunWriter:
    """Writes one run folder; a context manager that holds its lock.

        with RunWriter(folder, manifest) as run:
            for sample in samples:
                if run.wants(sample.id):
                    run.add(...)

    Samples with a status in `retry` are asked again, once a session.
    """

    def __init__(self, folder: str | Path, manifest: Manifest, retry: Iterable[Status] = ()) -> None:
        self.folder = Path(folder)
        self.manifest = manifest
        self.records: dict[str, Record] = {}
        self._retry = frozenset(retry)
        self._pending_retry: set[str] = set()
        self._file = -1
        self._held = ExitStack()

    def __enter__(self) -> RunWriter:
        """Create the folder or continue the one that exists.

        Raises:
            ConfigError: the folder belongs to another configuration; the message lists the differences.
            DataError: another process is writing it, or it is not a run folder.
        """
        try:
            self._open()
        except OSError as error:
            raise DataError(
                f"{str(self.folder)!r} cannot be written: {error}; choose another folder with --out"
            ) from error
        return self

    def _open(self) -> None:
        path = self.folder / "manifest.json"
        if not path.exists() and self.folder.is_dir() and _foreign(self.folder):
            raise DataError(f"{str(self.folder)!r} holds other files, not a run; choose another folder with --out")
        self.folder.mkdir(parents=True, exist_ok=True)
        with ExitStack() as held:
            held.enter_context(hold(self.folder / "lock"))
            _sweep(self.folder)
            if path.exists():
                self._adopt(_read_manifest(path))
            self.manifest = self.manifest.with_session()
            write_atomically(path, self.manifest.to_json().encode())
            samples = self.folder / "samples.jsonl"
            _repair(samples)
            self.records = read_records(samples, SCORED)
            self._pending_retry = {record.id for record in self.records.values() if record.status in self._retry}
            self._file = os.open(samples, os.O_WRONLY | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0), 0o644)
            held.callback(os.close, self._file)
            self._held = held.pop_all()

    def __exit__(self, *_: object) -> None:
        self._held.close()

    def wants(self, id: str) -> bool:
        """Whether this sample still needs an answer."""
        return id not in self.records or id in self._pending_retry

    @property
    def settled(self) -> int:
        """How many records are final."""
        return len(self.records) - len(self._pending_retry)

    def add(self, row: Mapping[str, Any]) -> Record:
        """Append a line; it is on the disk when this returns.

        Raises:
            DataError: it cannot be written.
        """
        row = redact(row)
        record = Record({key: row[key] for key in SCORED if key in row})
        line = json.dumps(row, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
        view = memoryview(line.encode("utf-8", "surrogatepass") + b"\n")
        try:
            while view:
                view = view[os.write(self._file, view) :]
            os.fsync(self._file)
        except OSError as error:
            raise DataError(f"{str(self.folder / 'samples.jsonl')!r} cannot be written: {error}") from error
        self.records[record.id] = record
        self._pending_retry.discard(record.id)
        return record

    def add_picture(self, image: Image) -> str:
        """Keep a picture as a JPEG of at most 768 pixels a side; returns its path below the folder."""
        name = f"images/{image_hash(image)[:20]}.jpg"
        path = self.folder / name
        if not path.exists():
            small = image.convert("RGB")
            small.thumbnail((PICTURE_SIDE, PICTURE_SIDE), Pillow.Resampling.LANCZOS, reducing_gap=2.0)
            write_atomically(path, encoded(small, "JPEG", quality=85))
        return name

    def add_animation(self, frames: Sequence[Image]) -> str:
        """Keep frames of one size as an animated WebP, five a second; returns its path below the folder."""
        name = f"images/{hashlib.sha256(''.join(image_hash(frame) for frame in frames).encode()).hexdigest()[:20]}.webp"
        path = self.folder / name
        if not path.exists():
            first, *others = frames
            options = {"append_images": others, "duration": 200, "loop": 0, "quality": 50, "method": 2}
            write_atomically(path, encoded(first, "WEBP", save_all=True, **options))
        return name

    def _adopt(self, there: Manifest) -> None:
        here = json.loads(json.dumps(self.manifest.identity, default=str))
        found = differences(there.identity, here)
        if found:
            shown = "; ".join(found[:6]) + (f"; and {len(found) - 6} more" if len(found) > 6 else "")
            raise ConfigError(
                f"{str(self.folder)!r} belongs to another configuration ({shown}); choose another folder with --out"
            )
        self.manifest = self.manifest.merged_with(there)


def write_atomically(path: Path, data: bytes) -> None:
    """Replace `path` as a whole: a reader sees the old content or the new one.

    Raises:
        DataError: it cannot be written.
    """
    try:
        replace_file(path, data, durable=True)
    except OSError as error:
        raise DataError(f"{str(path)!r} cannot be written: {error}") from error


@contextmanager
def hold(path: Path) -> Generator[None, None, None]:
    """Hold the lock file `path`, which names its holder.

    Raises:
        DataError: another process (or another writer in this one) holds it.
        OSError: it cannot be opened, or the file system has no locks.
    """
    file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            _lock(file)
        except (BlockingIOError, PermissionError) as error:  # POSIX, Windows
            holder = path.read_text(encoding="utf-8", errors="replace").strip() or "another process"
            raise DataError(f"{str(path.parent)!r} is being written by {holder}; wait for it, or stop it") from error
        os.ftruncate(file, 0)
        os.lseek(file, 0, os.SEEK_SET)
        os.write(file, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
        yield
    finally:
        os.close(file)


def _lock(file: int) -> None:
    """Lock or raise OSError at once."""
    if sys.platform == "win32":
        import msvcrt

        os.lseek(file, 1 << 30, os.SEEK_SET)  # beyond the text, so that others can still read who holds it
        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _repair(path: Path) -> None:
    """Cut off, or finish, a last line without its newline."""
    if not path.exists():
        return
    with path.open("r+b") as file:
        raw = file.read()
        whole = raw.rfind(b"\n") + 1
        if whole == len(raw):
            return
        try:
            json.loads(raw[whole:])["id"]
            file.write(b"\n")
        except (ValueError, KeyError, TypeError, RecursionError):
            file.truncate(whole)
        file.flush()
        os.fsync(file.fileno())


def _foreign(folder: Path) -> bool:
    """Whether the folder holds files other than those of a run that was killed as it started."""
    return any(not (path.name == "lock" or is_draft(path)) for path in folder.iterdir())


def _sweep(folder: Path) -> None:
    """Remove the drafts of a killed writer. The caller holds the folder's lock."""
    for place in (folder, folder / "images"):
        for path in place.iterdir() if place.is_dir() else ():
            if is_draft(path):
                path.unlink(missing_ok=True)
