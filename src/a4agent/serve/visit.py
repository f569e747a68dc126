"""What happens when a visitor of the page asks: the stages one after the other, and errors as sentences."""

from __future__ import annotations

import logging
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from a4agent.affordance import Affordance
from a4agent.agent import A4Agent
from a4agent.availability import Missing
from a4agent.config import Settings, load_settings
from a4agent.errors import A4Error, InputError
from a4agent.images import load_image
from a4agent.saving import save
from a4agent.serve import cards
from a4agent.serve.cards import Progress
from a4agent.serve.follow import follow

log = logging.getLogger(__name__)

MOST_PIXELS = 40_000_000
FILES = ("affordance.json", "overlay.png", "mask.png")
Update = tuple[Any, ...]
"""Message, picture, slider, stages, timings and the three files, as the page's components take them."""


class LoadedAgent:
    """Keeps the agent of the profile that was used last; another profile's takes its place in memory."""

    def __init__(self, load: Callable[[str], A4Agent]) -> None:
        self._load = load
        self._lock = threading.Lock()
        self._profile = ""
        self._agent: A4Agent | None = None

    def get(self, profile: str) -> A4Agent:
        """The agent of a profile.

        Raises:
            A4Error: it cannot be loaded; the next call tries again.
        """
        with self._lock:
            if self._agent is None or profile != self._profile:
                self._close()
                self._agent = self._load(profile)
                self._profile = profile
            return self._agent

    def close(self) -> None:
        """Let go of it."""
        with self._lock:
            self._close()

    def _close(self) -> None:
        if self._agent is not None:
            self._agent.close()
        self._agent = None


class Visit:
    """The page's only action."""

    def __init__(self, loaded: LoadedAgent, check: Callable[[str], Sequence[Missing]]) -> None:
        self._loaded = loaded
        self._check = check

    def run(self, photo: str | None, instruction: str, profile: str, dream: bool) -> Generator[Update]:
        """Predict, with an update of the page after each stage; what goes wrong is a sentence on it."""
        progress: Progress | None = None
        try:
            picture = _picture(photo, instruction)
            for missing in self._check(profile):
                raise InputError(f"The profile {profile!r} needs {missing.what}: {missing.fix}")
            yield _update(cards.message(f"Loading the models of the profile {profile!r} …", "busy"), None)
            agent = self._loaded.get(profile)
            if not dream:
                agent = replace(agent, dreamer=None)
            progress = Progress(picture, instruction.strip(), agent.dreamer is not None, agent.thinker is not None)
            yield _update("", progress)
            started = time.monotonic()
            for name, value in follow(agent, picture, instruction):
                progress = progress.after(name, value, time.monotonic() - started)
                if name != "affordance":
                    yield _update("", progress, redraw=name not in ("step", "imagination"))
            assert progress.affordance is not None
            yield from _finished(progress, progress.affordance)
        except A4Error as error:
            yield _update(cards.message(_sentence(str(error)), "error"), progress)
        except Exception:
            log.exception("a prediction failed")
            yield _update(cards.message("Something went wrong here; the server's log says what.", "error"), progress)

    def summary(self, profile: str) -> str:
        """One line about a profile."""
        settings = _settings(profile)
        if settings is None:
            return "its settings cannot be read"
        return " · ".join(part for part in (settings.profile.summary, settings.profile.memory) if part)

    def dreams(self, profile: str) -> bool:
        """Whether a profile has a Dreamer."""
        settings = _settings(profile)
        return settings is not None and settings.dreamer is not None


def _settings(profile: str) -> Settings | None:
    try:
        return load_settings(profile)
    except A4Error:
        return None


def _picture(photo: str | None, instruction: str) -> Any:
    if not photo:
        raise InputError("Add a photo first: drop one, paste one, or pick an example.")
    if not (instruction or "").strip():
        raise InputError("Say what you want to do, for instance “open the top drawer”.")
    try:
        return load_image(Path(photo).read_bytes(), max_pixels=MOST_PIXELS)
    except InputError as error:
        raise InputError(f"This photo cannot be used: {error}") from error


def _finished(progress: Progress, affordance: Affordance) -> Generator[Update]:
    with tempfile.TemporaryDirectory(prefix="a4-") as folder:
        save(affordance, Path(folder))
        yield _update(_verdict(affordance), progress, [str(Path(folder) / name) for name in FILES])


def _verdict(affordance: Affordance) -> str:
    if affordance.status == "ok":
        return ""
    if affordance.status == "empty":
        part = affordance.target.object_part if affordance.target else affordance.instruction
        return cards.message(f"Nothing in this photo was recognised as “{part}”. Try other words.", "note")
    what = "The model's answer could not be used" if affordance.status == "invalid" else "The models could not be asked"
    return cards.message(_sentence(f"{what}: {(affordance.error or '').partition(': ')[2]}"), "error")


def _sentence(words: str) -> str:
    words = words.strip()
    return words[:1].upper() + words[1:] + ("" if words.endswith((".", "!", "?")) else ".")


def _update(message: str, progress: Progress | None, files: list[str] | None = None, *, redraw: bool = True) -> Update:
    import gradio as gr

    affordance = progress.affordance if progress else None
    masked = affordance is not None and affordance.status == "ok"
    downloads = [gr.update(value=path, visible=True) for path in files or []] or [gr.update(visible=False)] * len(FILES)
    return (
        message,
        cards.picture(progress) if redraw else gr.skip(),
        gr.update(visible=masked),
        cards.stages(progress),
        cards.timings(affordance),
        *downloads,
    )
