"""One prediction, told as it goes: an iterator over what each stage found."""

from __future__ import annotations

import queue
import threading
from collections.abc import Generator
from typing import TYPE_CHECKING, Any

from a4agent.agent import A4Agent

if TYPE_CHECKING:
    from PIL.Image import Image

END = "end"


class _Left(Exception):
    """Nobody follows any more."""


def follow(agent: A4Agent, picture: Image, instruction: str) -> Generator[tuple[str, Any]]:
    """Yields ("step", (done, total)) while an editor paints, then each stage as `predict` tells it.

    The prediction runs on a thread of its own; closing the iterator stops it before its next stage.

    Raises:
        A4Error: what `predict` raises, after the stages before it.
    """
    told: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
    left = threading.Event()

    def tell(name: str, value: Any) -> None:
        if left.is_set():
            raise _Left
        told.put((name, value))

    def predict() -> None:
        try:
            agent.predict(
                picture, instruction, on_stage=tell, on_step=lambda done, total: told.put(("step", (done, total)))
            )
        except Exception as error:
            told.put((END, error))
        else:
            told.put((END, None))

    thread = threading.Thread(target=predict, name="a4-follow", daemon=True)
    thread.start()
    try:
        while True:
            name, value = told.get()
            if name == END:
                if value is not None:
                    raise value
                return
            yield name, value
    finally:
        left.set()
        thread.join()
