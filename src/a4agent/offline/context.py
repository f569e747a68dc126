"""What a sentence only tells, and what it asks: "The clean socks are put away in here. How do I get at them?".

    The milk has been put back. Where do I pull?    "where do i pull?"
    The kettle is hot. Where do I hold it?          "where do i hold it?", and the kettle
    Get me the cereal from in there.                "open it"

A question that names nothing is about what was told if the picture shows that or if it has a part for the question's
verb; otherwise it is about the main thing in the picture.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

from a4agent.offline.language import Reading, parse
from a4agent.offline.noun_phrases import Noun
from a4agent.offline.situation import Situation

S = TypeVar("S", bound=Situation)

_QUESTION = re.compile(
    r"(?:^|(?<=[.;:!?]) |, (?:so |and |but |then )?)"
    r"((?:(?:by|at|on|in|to) )?(?:what|where|which|how)\b[^.;:!?]*[?.!]*)"
)
_CONDITION = re.compile(r"\b(?:if|when|in case) (?:i|you|we|one)\b[^.;:!?]*")
_THERE = re.compile(r"\b(?:from|out of) (?:in |inside |behind )?(?:here|there)\b")
_HERE = re.compile(
    r"\b(?:in|inside|within|behind) "
    r"(?:(?:here|there)\b|(?:it|this|these|that|those)(?=[.,;:!?]|$| (?:and|so|but|is|are)\b))"
    rf"|{_THERE.pattern}|\b(?:is|are) (?:\w+ )?inside\b"
)
_IT_IS_FOR = re.compile(
    r"(?:^|[.;!?] )(?:this|that|it|these|those|they) (?:(?:should|must|will|would|could|has to|have to) )?"
    r"(?:covers?|fits?|closes?|belongs?|goes|go|shuts?|seals?)\b"
)
_NEEDS = re.compile(r"\b(?:needs?|wants?|have to|has to|must|would like)\b")
_FETCHED = frozenset(["get", "fetch", "take", "take out", "bring", "reach", "give", "hand", "pass", "hand me"])


def about(situation: S) -> S:
    """The situation without what its sentence only tells."""
    text = situation.reading.text
    questions = list(_QUESTION.finditer(text))
    if questions:
        return _asked(situation, *questions[-1].span(1))
    if _THERE.search(text) and _fetches(situation.reading) and not situation.shown(situation.reading.nouns):
        return replace(situation, reading=_opened(text))
    return situation


def _asked(situation: S, start: int, end: int) -> S:
    """The situation of the question from `start` to `end` of the sentence, if that names nothing itself."""
    text = situation.reading.text
    condition = _CONDITION.search(text, start, end)
    question = parse(text[start : condition.start() if condition else end])
    told = parse(f"{text[:start]} . {condition[0] if condition else ''} . {text[end:]}")
    if text[:end].rstrip("?!. ").endswith(" with"):  # "what do I cut it with?" asks for a tool
        return situation
    says_how = bool(question.verbs) or question.holding or any(noun.generic for noun in question.nouns)
    if any(_is_named(noun) for noun in question.nouns) or not told.nouns or not says_how:
        return situation
    named = [noun for noun in told.nouns if noun.thing and not (question.placing and noun.role == "object")]
    named = [noun for noun in named if told.words[noun.start - 1 : noun.start] != ("for",)]  # "water for the bath"
    if any(noun.pronoun and noun.role == "object" for noun in told.nouns):  # "carry it to the desk"
        named = [noun for noun in named if noun.role == "object"]
    inside = bool(_HERE.search(text))
    if _IT_IS_FOR.search(text) and not question.placing:  # "this covers the box": it is not the box
        others = {noun.thing.key for noun in named if noun.thing}
        situation = replace(situation, seen=tuple(thing for thing in situation.seen if thing.key not in others))
        meant: Sequence[Noun] | None = ()
    else:
        meant = _meant(named, question, situation, inside)
    if meant is None:
        return situation
    meant = sorted(meant, key=lambda noun: not noun.qualifiers)  # "the drawer, the lowest one"
    if inside and not meant and _fetches(question):
        question = _opened(text)
    if not meant:
        meant = [noun for noun in question.nouns if noun.pronoun or noun.generic]
        heights = [word for noun in told.nouns for word in noun.qualifiers if word in ("upper", "lower")]
        if question.placing and heights:  # "it should stand low down"
            meant = [Noun("object", 0, 0, qualifiers=(heights[0],), pronoun=True)]
    return replace(
        situation, reading=replace(question, text=text, nouns=tuple(meant), unwanted=situation.reading.unwanted)
    )


def _meant(named: Sequence[Noun], question: Reading, situation: Situation, inside: bool) -> Sequence[Noun] | None:
    """What was told of and is asked about, nothing if that is what the picture shows; None if all may matter."""
    if shown := situation.shown(named):
        return shown
    if inside:
        return ()
    if situation.wished() or (_NEEDS.search(situation.reading.text) and situation.reached_for()):
        return None
    actions = {action for verb in question.verbs for action in verb.actions}
    if fitting := [noun for noun in named if noun.thing and any(noun.thing.part_for(action) for action in actions)]:
        return fitting
    if named and not actions:
        return None
    return ()


def _is_named(noun: Noun) -> bool:
    """Whether a noun of a question says what it is about."""
    if noun.owner:
        return not noun.owner.pronoun
    place = noun.role in ("place", "goal") and (noun.thing or not noun.part)
    return not (noun.pronoun or noun.generic or place)


def _fetches(reading: Reading) -> bool:
    return any(verb.text in _FETCHED for verb in reading.verbs)


def _opened(text: str) -> Reading:
    return replace(parse("open it"), text=text)
