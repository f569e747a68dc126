"""What happens when a visitor of the page asks: the stages one after the other, and errors as sentences."""

from __future__ import annotations

import logging
import os
import stat
import tempfile
import time
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path
from typing import Any

from a4agent.errors import A4Error, InputError
from a4agent.imaging.load import load_image
from a4agent.serve import cards
from a4agent.serve.cards import Progress
from a4agent.serve.follow import follow
from a4agent.serve.profiles import Profiles
from a4agent.types import Affordance

log = logging.getLogger(__name__)

MOST_PIXELS = 40_000_000
MAX_UPLOAD_BYTES = 32 * 2**20
EXAMPLES_FOLDER = Path(__file__).resolve().parent / "examples"
FILES = ("affordance.json", "overlay.png", "mask.png")
Update = tuple[Any, ...]
"""Message, picture, slider, stages, timings and the three files, as the page's components take them."""


class Visit:
    """The page's only action."""

    def __init__(self, profiles: Profiles) -> None:
        self._profiles = profiles

    def run(self, photo: str | None, instruction: str, profile: str, dream: bool) -> Generator[Update]:
        """Predict, with an update of the page after each stage; what goes wrong is a sentence on it."""
        progress: Progress | None = None
        try:
            picture = _picture(photo, instruction)
            for missing in self._profiles.missing(profile):
                raise InputError(f"The profile {profile!r} needs {missing.what}: {missing.fix}")
            yield _update(cards.message(f"Loading the models of the profile {profile!r} …", "busy"), None)
            agent = self._profiles.agent(profile)
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


def _picture(photo: str | None, instruction: str) -> Any:
    if not photo:
        raise InputError("Add a photo first: drop one, paste one, or pick an example.")
    if not (instruction or "").strip():
        raise InputError("Say what you want to do, for instance “open the top drawer”.")
    try:
        return load_image(read_upload(photo), max_pixels=MOST_PIXELS)
    except InputError as error:
        raise InputError(f"This photo cannot be used: {error}") from error


def read_upload(path: str) -> bytes:
    """The bytes of a photo that a visitor uploaded, or of an example.

    gradio checks paths only in payloads that declare themselves files, so that a forged one names any file of the
    server. The path is resolved first, and the file is opened without following a link or waiting for a pipe.

    Raises:
        InputError: the path leads elsewhere, or to something other than a regular file of at most MAX_UPLOAD_BYTES.
    """
    from gradio.utils import get_upload_folder

    refused = InputError("Upload the photo on this page; files of the server are not read.")
    folders = (os.path.realpath(get_upload_folder()), str(EXAMPLES_FOLDER))
    try:
        real = Path(os.path.realpath(path))
        if not any(real.is_relative_to(folder) for folder in folders):
            raise refused
        descriptor = os.open(real, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except (OSError, ValueError) as error:
        raise refused from error
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise refused
        if status.st_size > MAX_UPLOAD_BYTES:
            raise InputError(f"This photo is larger than {MAX_UPLOAD_BYTES // 2**20} MB; upload a smaller one.")
        with open(descriptor, "rb", closefd=False) as file:
            return file.read(MAX_UPLOAD_BYTES)
    finally:
        os.close(descriptor)


def _finished(progress: Progress, affordance: Affordance) -> Generator[Update]:
    with tempfile.TemporaryDirectory(prefix="a4-") as folder:
        affordance.save(folder)
        yield _update(_verdict(affordance), progress, [str(Path(folder) / name) for name in FILES])


def _verdict(affordance: Affordance) -> str:
    if affordance.status == "ok":
        return ""
    if affordance.status == "empty":
        part = affordance.phrase
        return cards.message(f"Nothing in this photo was recognised as “{part}”. Try other words.", "note")
    what = "The model's answer could not be used" if affordance.status == "invalid" else "The models could not be asked"
    return cards.message(_sentence(f"{what}: {(affordance.error or '').partition(': ')[2]}"), "error")


def _sentence(words: str) -> str:
    words = words.strip()
    ends = words.rstrip("\"'”’").endswith((".", "!", "?"))
    return words[:1].upper() + words[1:] + ("" if ends else ".")


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
