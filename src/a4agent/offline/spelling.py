"""Spelling: words that are not known are replaced by the nearest word of the knowledge base.

corrected("pikc up teh scisors")   -> "pick up the scissors"
corrected("grabthe mug")           -> "grab the mug"
corrected("open the casket")       -> "open the casket": nobody mistypes the first letter of "basket" that way
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import lru_cache
from importlib.resources import files

from a4agent.errors import require
from a4agent.offline.knowledge import QUALIFIERS, knowledge, stem


@lru_cache(maxsize=1)
def common_words() -> frozenset[str]:
    """Everyday words that are spelt right although the knowledge base does not need them."""
    text = files("a4agent.offline").joinpath("common_words.txt").read_text(encoding="utf-8")
    return frozenset(text.split())


@lru_cache(maxsize=1)
def _known() -> tuple[frozenset[str], tuple[str, ...]]:
    """Stems of all words that are left alone, and the words that others may be corrected to."""
    know = knowledge()
    phrases = [*know.object_index, *know.part_index, *know.action_index, *know.theme_index]
    stems = {word for phrase in phrases for word in phrase} | {stem(word)[0] for word in common_words()}
    stems |= {word for names in know.untouchable for word in names}
    stems |= {stem(word)[0] for wish in know.wishes for word in re.findall("[a-z]{4,}", wish.says)}
    return frozenset(stems), tuple(sorted(set(know.written) | set(common_words()) | set(QUALIFIERS)))


def corrected(text: str) -> str:
    """The text (lower case) with unknown words replaced by near ones that are known."""
    before = ""

    def mended(match: re.Match[str]) -> str:
        nonlocal before
        word = _word(match[0], before in _ARTICLES)
        before = word
        return word

    return re.sub(r"[a-z]+(?:[-'][a-z]+)*", mended, text)


_ARTICLES = frozenset(["the", "a", "an", "my", "your", "this"])


@lru_cache(maxsize=1)
def _nouns() -> tuple[str, ...]:
    """The words that may follow an article: all but verbs."""
    know = knowledge()
    named = [*know.object_index, *know.part_index, *know.theme_index]
    stems = {word for phrase in named for word in stem(phrase)}
    return tuple(
        word for word in _known()[1] if word not in know.written or stem(word)[0] in stems or word in QUALIFIERS
    )


@lru_cache(maxsize=4096)
def _word(word: str, noun: bool) -> str:
    stems, vocabulary = _known()
    stemmed = stem(word)
    known = stemmed and stemmed[0] in stems and (word != stemmed[0] or word in vocabulary or len(word) > 5)
    if len(word) < 3 or not stemmed or known or word.endswith("ly"):
        return word
    if "-" in word or "'" in word:
        joined = word.replace("-", "")
        return joined if stem(joined) and stem(joined)[0] in stems else word
    glued = next((end for end in ("the", "this", "that", "my", "it") if word.endswith(end)), None)
    if glued and word.removesuffix(glued) in vocabulary:
        return f"{word.removesuffix(glued)} {glued}"
    return _nearest(word, _nouns() if noun else vocabulary) or word


def _nearest(word: str, vocabulary: Iterable[str]) -> str | None:
    """The nearest known word that a slip of the fingers explains, None if there is none."""
    rapidfuzz = require("rapidfuzz", extra="offline")
    found = rapidfuzz.process.extract(
        word, vocabulary, scorer=rapidfuzz.distance.OSA.distance, score_cutoff=2, limit=40
    )
    likely = [
        (distance, *_unlikelihood(word, other), other)
        for other, distance, _ in found
        if _possible(word, other, distance)
    ]
    return min(likely)[-1] if likely else None


_VOWELS = frozenset("aeiouy")


def _possible(word: str, other: str, distance: float) -> bool:
    """Whether one may be typed for the other: the first letter is rarely wrong, and short words differ by more."""
    if distance > 1 and len(word) < 8 and (len(word) < 5 or sorted(_squeezed(word)) != sorted(_squeezed(other))):
        return False
    if other[1:] == word and other[0] in "kwhg" and len(word) > 3:
        return True  # "nife", "rench"
    if len(other) < 3 or (word[0] != other[0] and sorted(word[:2]) != sorted(other[:2])):
        return False
    if abs(len(word) - len(other)) > 1 and (word.startswith(other) or other.startswith(word)):
        return False  # "decanter" is a word of its own
    if len(word) == 3:
        return len(other) == 4 or sorted(word) == sorted(other)
    return len(word) > 4 or _slip(word, other) < 3


def _squeezed(word: str) -> str:
    """A word without doubled letters."""
    return re.sub(r"(.)\1+", r"\1", word)


def _slip(word: str, other: str) -> int:
    """How unlikely a slip is: swapped letters, a doubled letter or wrong vowel, a missing, an added, a wrong letter."""
    if sorted(word) == sorted(other):
        return 0
    if len(word) == len(other):
        wrong = {letter for pair in zip(word, other, strict=True) if pair[0] != pair[1] for letter in pair}
        return 1 if wrong <= _VOWELS else 4
    if _squeezed(word) == _squeezed(other):
        return 1
    return 2 if len(other) > len(word) else 3


def _unlikelihood(word: str, other: str) -> tuple[int, bool, int]:
    """Smaller for likelier slips, then for words of the knowledge base, then by the length of the common beginning."""
    pairs = enumerate(zip(word, other, strict=False))
    beginning = next((at for at, (a, b) in pairs if a != b), min(len(word), len(other)))
    return _slip(word, other), other not in knowledge().written, -beginning
