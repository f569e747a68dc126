"""What a run is: the configuration that decides its answers, and the circumstances of each start.

    {
     "schema": 1,
     "identity": {                                    # two runs with one identity give the same answers
       "benchmark": "umd", "data": {"options": {"rule": "a4"}, "revision": "", "rows": 1922, "sha256": "9f3c...", ...},
       "selection": {"limit": 100, "shuffle": 7, "samples": 100}, "protocol": "strict", "oracle": null,
       "settings": {"dreamer": null, "thinker": {"vlm": "openai:gpt-4o", "prompts": "paper", ...}, "spotter": ...},
       "experts": [{"id": "sam2:tiny", "revision": "", "settings": {...}}],
       "prompts": {"thinker": "8d0b2f..."}
     },
     "about": {"profile": "paper", "label": "A4-Agent", "data": "/data/umd", "licence": "...", ...},
     "sessions": [{"started": "2026-11-22T07:40:00+00:00", "command": "a4 bench ...", "versions": {...}, "git": {...}}]
    }

A folder holds one identity; every start adds a session, and any new label to "labels" in "about".
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import platform
import shlex
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime, timezone
from functools import cache
from pathlib import Path
from typing import Any, Literal, cast

from pydantic import BaseModel, ValidationError

from a4agent import prompts
from a4agent.config import STAGES, Settings
from a4agent.errors import DataError, first_problem
from a4agent.redaction import redact
from a4agent.stages.calibration import load_calibration

SCHEMA = 1
LIBRARIES = ("numpy", "pillow", "scipy", "torch", "transformers", "diffusers", "openai", "onnxruntime", "ray")

LEAKS = {
    "trained": "trained on this data",
    "truth": "truth of the test set seen",
    "shared": "test images in a memory or template bank",
}
"""What can inflate a score, as questions that are answered "yes", "no" or "unknown"."""


@dataclass(frozen=True)
class Manifest:
    """The content of manifest.json."""

    identity: Mapping[str, Any]
    about: Mapping[str, Any] = field(default_factory=dict)
    sessions: tuple[Mapping[str, Any], ...] = ()

    def __post_init__(self) -> None:
        for name in ("identity", "about", "sessions"):
            object.__setattr__(self, name, redact(getattr(self, name)))

    @property
    def hash(self) -> str:
        """Eight hexadecimal digits that name the configuration."""
        return _short_hash(self.identity)

    @property
    def system(self) -> str:
        """Names the system: its runs on several benchmarks share this value."""
        return _short_hash({key: self.identity.get(key) for key in ("settings", "experts", "prompts", "oracle")})

    @property
    def label(self) -> str:
        """This configuration's name for people."""
        name = str(self.about.get("label") or self.about.get("profile") or self.hash)
        oracle = self.identity.get("oracle")
        return f"{name}, {oracle} by the truth" if oracle else name

    @property
    def labels(self) -> tuple[str, ...]:
        """All labels of this configuration, which may be a row of several tables."""
        return tuple(self.about.get("labels") or filter(None, [self.about.get("label")]))

    @property
    def leaks(self) -> dict[str, str]:
        """The answers to `LEAKS`. Our own stages see queries only and keep no memory; the rest must be declared."""
        ours = "predictions" not in self.identity
        known = {"truth": "no", "shared": "no"} if ours else {}
        oracle = {"truth": "yes"} if self.identity.get("oracle") else {}
        return {**dict.fromkeys(LEAKS, "unknown"), **known, **(self.about.get("leaks") or {}), **oracle}

    def merged_with(self, there: Manifest) -> Manifest:
        """This manifest with the sessions and labels of `there`, which has the same configuration."""
        named = self.about.get("label") or there.about.get("label") or ""
        labels = list(dict.fromkeys(filter(None, (*there.labels, named))))
        return Manifest(there.identity, {**there.about, **self.about, "label": named, "labels": labels}, there.sessions)

    def with_session(self) -> Manifest:
        """The same manifest with the circumstances of this process added."""
        return replace(self, sessions=(*self.sessions, circumstances()))

    def to_json(self) -> str:
        """Readable JSON."""
        return json.dumps({"schema": SCHEMA, **asdict(self)}, indent=1, ensure_ascii=False, default=str) + "\n"

    @classmethod
    def from_json(cls, text: str | bytes, name: str) -> Manifest:
        """The inverse of `to_json`.

        Raises:
            DataError: not a manifest, or one of another version.
        """
        try:
            data = json.loads(text)
            if isinstance(data, dict) and data.get("schema") != SCHEMA:  # pyright: ignore[reportUnknownMemberType]
                raise DataError(f"{name!r} has schema {data.get('schema')!r}; this version reads {SCHEMA}")  # pyright: ignore
            _File.model_validate(data)
            return cls(data["identity"], data["about"], tuple(data["sessions"]))
        except ValidationError as error:
            problem = first_problem(error, "the file")
            raise DataError(f"{name!r} is not the manifest of a run: {problem}") from error
        except (ValueError, RecursionError) as error:
            raise DataError(f"{name!r} is not the manifest of a run: {error}") from error


class _Selection(BaseModel):
    limit: int | None
    shuffle: int | None
    samples: int


class _Identity(BaseModel):
    benchmark: str
    protocol: str
    oracle: Literal["thinker", "detector", "segmenter"] | None
    selection: _Selection


class _Git(BaseModel):
    commit: str
    dirty: bool


class _Session(BaseModel):
    started: str
    command: str
    versions: dict[str, str]
    git: _Git | None


class _File(BaseModel):
    """The fields of manifest.json that reports and tables need. The file may come from anywhere, so it is checked."""

    identity: _Identity
    about: dict[str, Any]
    sessions: list[_Session]


def settings_identity(settings: Settings) -> dict[str, Any]:
    """The settings that decide an answer, with experts by name only.

    Experts' fingerprints hold the settings that change answers, so a smaller batch or a new server address does not
    start a new run.
    """
    found = settings.model_dump(mode="json", include={*STAGES, "image"})
    for name in settings.expert_specs():
        stage, role = name.split(".")
        found[stage][role] = found[stage][role]["expert"]
    if settings.verifier and settings.verifier.calibration:  # the file's content counts, not its path
        found["verifier"]["calibration"] = load_calibration(settings.verifier.calibration).sha256
    return found


def settings_shown(settings: Settings) -> dict[str, Any]:
    """All settings, without secrets, for readers of the manifest."""
    return redact(settings.model_dump(mode="json", exclude={"profile", "name"}))


def prompt_hashes(settings: Settings) -> dict[str, str]:
    """The hash of each prompt template that the settings use."""
    found: dict[str, str] = {}
    if settings.dreamer:
        found["dreamer"] = prompts.text_hash(prompts.load(settings.dreamer.prompts, "dreamer"))
    if settings.verifier and settings.verifier.vlm:
        found["verifier"] = prompts.text_hash(prompts.load(settings.verifier.prompts, "verifier"))
    if settings.thinker:
        template = "thinker" if settings.dreamer else "thinker_one_image"
        found[template] = prompts.text_hash(prompts.load(settings.thinker.prompts, template))
    return found


def differences(there: Any, here: Any, name: str = "") -> list[str]:
    """How two JSON values differ, as lines "settings.spotter.pairing: 'paper' there, 'optimal' here"."""
    if isinstance(there, Mapping) and isinstance(here, Mapping):
        a, b = cast("Mapping[str, Any]", there), cast("Mapping[str, Any]", here)
        lines: list[str] = []
        for key in [*a, *(key for key in b if key not in a)]:
            lines += differences(a.get(key), b.get(key), f"{name}.{key}" if name else str(key))
        return lines
    if isinstance(there, list) and isinstance(here, list) and len(there) == len(here):
        pairs = enumerate(zip(there, here, strict=True))
        return [line for i, (a, b) in pairs for line in differences(a, b, f"{name}[{i}]")]
    return [] if there == here else [f"{name}: {_short(there)} there, {_short(here)} here"]


def circumstances() -> dict[str, Any]:
    """When, where, by what command and with which versions this process runs."""
    return {
        "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "machine": f"{platform.system()} {platform.machine()}",
        "versions": versions(),
        "git": git_state(Path(__file__).parent),
    }


@cache
def versions() -> dict[str, str]:
    """Installed versions of Python, this package and the libraries that affect answers."""
    found = {"python": platform.python_version()}
    for library in ("a4agent", *LIBRARIES):
        try:
            found[library] = importlib.metadata.version(library)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


@cache
def git_state(folder: Path) -> dict[str, Any] | None:
    """The commit of the checkout that holds this code, and whether it has changes; None without a checkout."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", "__init__.py")  # an installed package may lie in another project's checkout
        return {"commit": git("rev-parse", "HEAD"), "dirty": bool(git("status", "--porcelain", "--", ".."))}
    except (OSError, subprocess.SubprocessError):
        return None


def _short_hash(value: Any) -> str:
    text = json.dumps(value, sort_keys=True, ensure_ascii=False, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def _short(value: Any) -> str:
    text = "nothing" if value is None else repr(value)
    return text if len(text) <= 120 else f"{text[:117]}..."
