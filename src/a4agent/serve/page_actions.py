"""What the page does when a visitor asks: the profiles to choose from, the upload, and the stages one after another."""

from __future__ import annotations

import asyncio
import logging
import tempfile
import threading
from collections.abc import AsyncGenerator, Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from PIL.Image import Image

from a4agent.agent import A4Agent
from a4agent.config import Settings
from a4agent.errors import A4Error, InputError, MissingExtraError, UnknownNameError
from a4agent.imaging.load import load_image
from a4agent.requirements import Missing
from a4agent.serve import EXAMPLES_FOLDER, page_views
from a4agent.serve.admission import read_below
from a4agent.serve.page_views import StageProgress
from a4agent.serve.workers import Cancelled
from a4agent.types import Affordance

log = logging.getLogger(__name__)

MAX_UPLOAD_BYTES = 32 * 2**20
MAX_UPLOAD_PIXELS = 120_000_000
SHRINK_TO_PIXELS = 12_000_000
"""Larger photos are scaled down."""
FILES = ("affordance.json", "overlay.png", "mask.png")
FILES_BY_STATUS = {"ok": FILES, "abstained": FILES, "empty": FILES[:2]}
Update = tuple[Any, ...]
"""Message, picture, slider, stages, timings and the three files, as the page's components take them."""

T = TypeVar("T")


class Profiles:
    """The profiles a visitor may choose. One agent is in memory at a time: the one that was asked for last."""

    def __init__(
        self,
        settings: Callable[[str], Settings],
        load: Callable[[Settings], A4Agent],
        check: Callable[[Settings], Sequence[Missing]],
        names: Sequence[str],
    ) -> None:
        self.names = tuple(names)
        self._read_settings = settings
        self._load = load
        self._check = check
        self._lock = threading.Lock()
        self._loaded = ""
        self._agent: A4Agent | None = None

    def settings(self, name: str) -> Settings:
        """The settings of a listed profile. A visitor's name is never a path: a TOML file names keys and addresses.

        Raises:
            UnknownNameError: the name is not in the list.
        """
        if name not in self.names:
            raise UnknownNameError(f"unknown profile {name!r}; choose one of {', '.join(self.names)}")
        return self._read_settings(name)

    def agent(self, name: str) -> A4Agent:
        """The agent of a profile.

        Raises:
            A4Error: it cannot be loaded; the next call tries again.
        """
        with self._lock:
            if self._agent is None or name != self._loaded:
                self._unload()
                self._agent = self._load(self.settings(name))
                self._loaded = name
            return self._agent

    def close(self) -> None:
        """Unload the models."""
        with self._lock:
            self._unload()

    def summary(self, name: str) -> str:
        """One line about a profile."""
        try:
            info = self.settings(name).profile
        except A4Error:
            return "its settings cannot be read"
        return " · ".join(part for part in (info.summary, info.memory) if part)

    def dreams(self, name: str) -> bool:
        """Whether a profile has a Dreamer."""
        try:
            return self.settings(name).dreamer is not None
        except A4Error:
            return False

    def missing(self, name: str) -> Sequence[Missing]:
        """What this machine lacks for a profile."""
        try:
            return self._check(self.settings(name))
        except A4Error as error:
            return [Missing(str(error), "a4 doctor")]

    def _unload(self) -> None:
        if self._agent is not None:
            self._agent.close()
        self._agent = None


class Visit:
    """The page's only action."""

    def __init__(self, profiles: Profiles) -> None:
        self._profiles = profiles

    async def run(self, photo: str | None, instruction: str, profile: str, dream: bool) -> AsyncGenerator[Update]:
        """Predict, with an update of the page after each stage. Every failure is a sentence on the page."""
        progress: StageProgress | None = None
        try:
            picture = await asyncio.to_thread(_picture, photo, instruction)
            for missing in await asyncio.to_thread(self._profiles.missing, profile):
                raise InputError(f"The profile {profile!r} needs {missing.what}: {missing.fix}")
            yield _update(page_views.message(f"Loading the models of the profile {profile!r} …", "busy"), None)
            agent = await asyncio.to_thread(self._profiles.agent, profile)
            if not dream:
                agent = replace(agent, dreamer=None)
            progress = StageProgress(
                picture,
                instruction.strip(),
                dreams=agent.dreamer is not None,
                thinks=agent.thinker is not None,
                verifies=agent.verifier is not None,
            )
            yield await asyncio.to_thread(_update, "", progress)
            began = asyncio.get_running_loop().time()
            async for name, value in _stages(agent, picture, instruction):
                progress = progress.after(name, value, asyncio.get_running_loop().time() - began)
                if name != "affordance":
                    redraw = name not in ("step", "imagination")
                    yield await asyncio.to_thread(_update, "", progress, redraw=redraw)
            assert progress.affordance is not None
            with tempfile.TemporaryDirectory(prefix="a4-") as folder:
                yield await asyncio.to_thread(_finished, progress, progress.affordance, Path(folder))
        except A4Error as error:
            yield _update(page_views.message(sentence(str(error)), "error"), progress)
        except Exception:
            log.exception("a prediction failed")
            yield _update(page_views.message("Something went wrong; the server's log has the details.", "error"), None)


async def _stages(agent: A4Agent, picture: Image, instruction: str) -> AsyncGenerator[tuple[str, Any]]:
    """("step", (done, total)) while an editor paints, and each stage's result as the prediction's thread finds it.

    Closing the generator stops the prediction before its next stage.
    """
    loop = asyncio.get_running_loop()
    found: asyncio.Queue[tuple[str, Any]] = asyncio.Queue()
    closed = threading.Event()

    def tell(name: str, value: Any) -> None:
        if closed.is_set():
            raise Cancelled
        loop.call_soon_threadsafe(found.put_nowait, (name, value))

    prediction = loop.run_in_executor(
        None,
        lambda: agent.predict(
            picture, instruction, on_stage=tell, on_step=lambda done, total: tell("step", (done, total))
        ),
    )
    prediction.add_done_callback(lambda _: found.put_nowait(("", None)))
    try:
        while (event := await found.get())[0]:
            yield event
        await prediction
    finally:
        closed.set()
        await asyncio.wait({prediction})
        prediction.exception()  # retrieved, whether or not anybody waited for it


def _picture(photo: str | None, instruction: str) -> Image:
    """The photo as the agent gets it: upright, RGB, at most SHRINK_TO_PIXELS."""
    if not photo:
        raise InputError("Add a photo first: drop one, paste one, take one, or pick an example.")
    if not (instruction or "").strip():
        raise InputError("Say what you want to do, for instance “open the top drawer”.")
    try:
        return load_image(read_upload(photo), max_pixels=MAX_UPLOAD_PIXELS, shrink_to=SHRINK_TO_PIXELS)
    except (InputError, MissingExtraError) as error:
        raise InputError(f"This photo cannot be used: {error}") from error


def read_upload(path: str) -> bytes:
    """The bytes of a photo that a visitor uploaded, or of an example.

    gradio checks paths only in payloads that declare themselves files, so that a forged one names any file of the
    server.

    Raises:
        InputError: the path leads elsewhere, or to something other than a regular file of at most MAX_UPLOAD_BYTES.
    """
    from gradio.utils import get_upload_folder

    try:
        return read_below(path, (Path(get_upload_folder()), EXAMPLES_FOLDER), MAX_UPLOAD_BYTES)
    except InputError as error:
        raise InputError(f"upload the photo on this page; files of the server are not read ({error})") from error


def _finished(progress: StageProgress, affordance: Affordance, folder: Path) -> Update:
    affordance.save(folder)
    files = [folder / name for name in FILES_BY_STATUS.get(affordance.status, ())]
    return _update(_verdict(affordance), progress, files)


def _verdict(affordance: Affordance) -> str:
    """The message below the button; "" for an accepted answer."""
    if affordance.status == "ok":
        return ""
    if affordance.status == "abstained":
        worst = page_views.worst_check(affordance)
        reason = f" {sentence(worst.note)}" if worst and (worst.value or 0.0) < 0.5 else ""
        return page_views.message(f"This is a guess: check it before you act on it.{reason}", "note")
    if affordance.status == "empty":
        part = affordance.phrase
        return page_views.message(f"Nothing in this photo was recognised as “{part}”. Try other words.", "note")
    what = "The model's answer could not be used" if affordance.status == "invalid" else "The models could not be asked"
    return page_views.message(sentence(f"{what}: {affordance.reason}"), "error")


def sentence(words: str) -> str:
    """Words with a capital letter and a full stop, if they have no other end."""
    words = words.strip()
    ends = words.rstrip("\"'”’").endswith((".", "!", "?"))
    return words[:1].upper() + words[1:] + ("" if ends else ".")


def _update(message: str, progress: StageProgress | None, files: Sequence[Path] = (), *, redraw: bool = True) -> Update:
    import gradio as gr

    affordance = progress.affordance if progress else None
    masked = affordance is not None and affordance.status in ("ok", "abstained")
    by_name = {path.name: str(path) for path in files}
    downloads = [
        gr.update(value=by_name[name], visible=True) if name in by_name else gr.update(value=None, visible=False)
        for name in FILES
    ]
    return (
        message,
        page_views.picture(progress) if redraw else gr.skip(),
        gr.update(visible=masked),
        page_views.stages(progress),
        page_views.timings(affordance),
        *downloads,
    )
