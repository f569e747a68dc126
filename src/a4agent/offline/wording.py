"""English as people speak it, made plain for the rules: split verbs joined, noun phrases picked out.

plain("switch the light on", verbs)              -> "switch on the light"
plain("throw both doors of the cupboard open")   -> "open both doors of the cupboard"
modifiers(["press", "the", "red", "button"], 3)  -> ["red"], what stands between "the" and word 3
noun_from(["open", "the", "old", "hatch"], 1)    -> "old hatch", the definite noun phrase that starts there
"""

from __future__ import annotations

import re
from collections.abc import Container, Sequence

from a4agent.offline.knowledge import stem

DEFINITE = frozenset(["the", "this", "that", "these", "those", "my", "your", "our", "his", "her", "their", "its"])
_ANY_NUMBER = "a|an|all|any|both|each|either|every|one|some|" + "|".join(sorted(DEFINITE))
_SPLIT_VERB = re.compile(
    rf"\b([a-z]+) ((?:{_ANY_NUMBER})(?: [\w'-]+){{1,7}}?|it|them|this|that) "
    r"(on|off|up|down|in|out|open|shut|closed|away|over|back)"
    r"(?=\s*(?:$|[.,;:?!]|\b(?:and|again|before|by|for|from|in|into|now|onto|please|so|then|to|until|using|with)\b))"
)
_OPENED = {"open": "open", "shut": "close", "closed": "close"}
_SMALL_WORDS = """
a about above across after again all along am an and are around as aside at away back be before behind below
beneath beside between both but by can could do does down each either first for from go goes has have he here how
i if in inside into is it me must near next not now of off on one onto or other out over please same she should so than
that the then there they this those through to together under until up us using was we were what when where which
while who why will with without would you
"""
_NO_NOUN = frozenset(_SMALL_WORDS.split())


def plain(text: str, verbs: Container[tuple[str, ...]]) -> str:
    """`text` (lower case) with verb and particle side by side where they are one of `verbs` (stemmed).

    Whatever is thrown, pushed or slid open is opened, and whatever is pulled shut is closed. "Back" goes, lest
    it be taken for a chair's.
    """

    def joined(match: re.Match[str]) -> str:
        verb, noun, particle = match.groups()
        if particle == "back":
            return f"{verb} {noun}" if stem(verb) in verbs else match[0]
        if stem(f"{verb} {particle}") in verbs:
            return f"{verb} {particle} {noun}"
        if particle in _OPENED and stem(verb) in verbs:
            return f"{_OPENED[particle]} {noun}"
        return match[0]

    return _SPLIT_VERB.sub(joined, text)


def modifiers(said: Sequence[str], start: int) -> list[str] | None:
    """The words, three at most, between a definite word and `said[start]`; None where there is no such word."""
    for before in range(start - 1, max(-1, start - 5), -1):
        if said[before] in DEFINITE:
            return list(said[before + 1 : start])
        if said[before] in _NO_NOUN:
            return None
    return None


def noun_from(said: Sequence[str], start: int) -> str | None:
    """The definite noun phrase that starts at a word, without its article; "object" for "it" and "this" alone."""
    if start >= len(said):
        return None
    end = start + 1
    while end < len(said) and end - start < 4 and said[end] not in _NO_NOUN | DEFINITE:
        end += 1
    if said[start] in DEFINITE and end > start + 1:
        return " ".join(said[start + 1 : end])
    return "object" if said[start] in {"it", "this", "that", "these", "those", "them"} else None


def first_noun(said: Sequence[str]) -> str | None:
    """The first definite noun phrase, None if there is none."""
    found = (noun_from(said, index) for index, word in enumerate(said) if word in DEFINITE)
    return next((noun for noun in found if noun), None)
