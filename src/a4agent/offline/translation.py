"""Instructions in German, French, Spanish, Italian and Dutch, word by word into English: `languages.toml`.

in_english("nimm die rote tasse")   -> "take the red cup"
in_english("open the door")         -> "open the door"
in_english("otwórz drzwi")          -> None: not in the tables
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

from a4agent.files import read_package_toml
from a4agent.offline.knowledge import knowledge, stem
from a4agent.offline.spelling import common_words

_ENOUGH = 0.75
"""The share of a foreign sentence's words that must be in its table."""


_ADJECTIVE_LAST = re.compile(
    r"\b(?!the\b|a\b|on\b|at\b|my\b|and\b|to\b)([a-z]+) (red|black|blue|green|white|left|right)\b"
    r"(?=[ ,.!?]*(?:$|of|with|from|by|in|on|and|please))"
)
"""A colour or side after its noun, as in Spanish."""


@dataclass(frozen=True)
class _Language:
    frames: tuple[tuple[str, str], ...]
    words: Mapping[tuple[str, ...], str]


@lru_cache(maxsize=1)
def _languages() -> tuple[_Language, ...]:
    table = read_package_toml("a4agent.offline", "languages.toml")
    return tuple(
        _Language(
            tuple((pattern, english) for pattern, english in row["frames"]),
            {tuple(word.split()): english for word, english in row["words"].items()},
        )
        for row in table.values()
    )


def in_english(text: str) -> str | None:
    """The text (lower case) in English, None if it is in a language that the tables do not cover."""
    letters = [character for character in text if character.isalpha()]
    plain = _without_accents(text)
    if not letters or sum(character.isascii() for character in plain if character.isalpha()) < len(letters):
        return None
    said = re.findall(r"[a-z0-9]+(?:-[a-z0-9]+)*", plain)
    english = sum(_is_english(word) for word in said)
    if english >= 0.8 * len(said) and plain == text:
        return text
    best = max(_languages(), key=lambda language: _count_known(said, language))
    known = _count_known(said, best)
    if known <= english:
        return text if english >= 0.3 * len(said) else None
    if known < _ENOUGH * len(said):
        return None
    for pattern, frame in best.frames:
        plain = re.sub(pattern, frame, plain)
    phrases = _phrases(re.findall(r"[a-z0-9]+(?:-[a-z0-9]+)*|[,;:.!?]", plain), best)
    return _ADJECTIVE_LAST.sub(r"\2 \1", " ".join(best.words.get(phrase, phrase[0]) for phrase in phrases))


def _without_accents(text: str) -> str:
    """ "öffne" -> "offne", "d'eau" -> "de eau"."""
    split = re.sub(r"-(moi|toi|tu|vous|le|la|les|nous)\b", r" \1", text.replace("ß", "ss"))
    letters = "".join(c for c in unicodedata.normalize("NFKD", split) if not unicodedata.combining(c))
    return re.sub(r"\b([dlsjn]|qu)'(?=[a-z]{2})", r"\1e ", letters)


def _is_english(word: str) -> bool:
    return word in common_words() or word in knowledge().written or stem(word) in knowledge().action_index


def _count_known(said: Sequence[str], language: _Language) -> int:
    return sum(len(phrase) for phrase in _phrases(said, language) if phrase in language.words)


def _phrases(said: Sequence[str], language: _Language) -> Iterator[tuple[str, ...]]:
    """The words cut into the longest phrases that the language's table holds; a word that it lacks stands alone."""
    at = 0
    while at < len(said):
        phrases = (tuple(said[at : at + length]) for length in (4, 3, 2, 1))
        phrase = next((phrase for phrase in phrases if phrase in language.words), (said[at],))
        yield phrase
        at += len(phrase)
