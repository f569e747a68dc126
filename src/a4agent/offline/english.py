"""Whether a text is English, judged by its alphabet and its smallest words."""

from __future__ import annotations

from a4agent.offline.knowledge import words

_ENGLISH_WORDS = """
the a an i it my me you your to of with in on for from into and is are this that what which where how can should part
want need would like some at by use do does put up off out get without we them please
"""
_FOREIGN_WORDS = """
le la les un une des du et est pour avec sur dans der die das den dem ein eine einen und ist mit zum zur auf el los las
una unos para con por del en il lo gli uno che di per o os um uma com em na no ao de het een van met voor op w z się
jest og att och med som på det ett ja
"""
_ENGLISH = frozenset(_ENGLISH_WORDS.split())
_FOREIGN = frozenset(_FOREIGN_WORDS.split())


def is_english(text: str) -> bool:
    """False for other alphabets, and where the small words of other languages outnumber the English ones."""
    letters = [character for character in text if character.isalpha()]
    if not letters or sum(character.isascii() for character in letters) < 0.8 * len(letters):
        return False
    said = words(text)
    return sum(word in _FOREIGN for word in said) <= sum(word in _ENGLISH for word in said)
