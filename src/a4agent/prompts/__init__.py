"""The prompt templates as text files, one folder for each set. `paper` is arXiv 2512.14442's, verbatim.

    prompts/paper/dreamer.txt              (I, T) -> edit prompt
    prompts/paper/thinker.txt              (I, I_sim, T) -> the part
    prompts/paper/thinker_one_image.txt    (I, T) -> the part; only the sentences on the second image differ
    prompts/verifier/review.txt            (overlay, crop, T, part) -> a review; the project's own

A set may also be a folder with files of the same names. Where a template holds `"TASK"`, the
instruction takes the place of TASK; otherwise it follows at the end.
"""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path

from a4agent.errors import ConfigError, UnknownNameError

HERE = Path(__file__).parent
PLACEHOLDER = '"TASK"'


@lru_cache(maxsize=64)
def load(prompt_set: str, name: str) -> str:
    """The template `name` ("dreamer", "thinker", "thinker_one_image") of a set or folder.

    Raises:
        UnknownNameError: there is no such set.
        ConfigError: the set has no such template.
    """
    folder = HERE / prompt_set
    if not folder.is_dir():
        folder = Path(prompt_set)
    if not folder.is_dir():
        known = [path.name for path in HERE.iterdir() if path.is_dir() and not path.name.startswith("_")]
        raise UnknownNameError.of("prompt set", prompt_set, known)
    path = folder / f"{name}.txt"
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise ConfigError(f"the prompt set {prompt_set!r} has no {name}.txt") from error


def fill(template: str, instruction: str) -> str:
    """The template with the instruction in its place."""
    if PLACEHOLDER in template:
        return template.replace(PLACEHOLDER, f'"{instruction}"')
    return f"{template.rstrip()}\n{instruction}\n"


def text_hash(*texts: str | None) -> str:
    """The first 16 hexadecimal digits of the sha256 of the texts: a prompt's name in logs and keys."""
    digest = hashlib.sha256()
    for text in texts:
        digest.update(b"\0" if text is None else text.encode() + b"\1")
    return digest.hexdigest()[:16]
