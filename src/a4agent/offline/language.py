"""English sentences as far as the offline Thinker needs them: spelling, verbs, noun phrases, what is ruled out.

    read("Could you please pikc up the black mug by its handle, not by the rim?")
    -> Reading(verbs=(pick up,), nouns=(black mug, handle), unwanted=(rim,), ...)

The steps, each a short function: contractions and polite frames go; words that nobody knows are matched with the
words of knowledge.toml by edit distance; what follows "not", "without" or "instead of" is set apart; so is the
purpose ("so that ...", "to ..."); the word before tells a verb from a noun; what is left are noun phrases.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from a4agent.offline.clauses import joined_verbs, main_and_purpose, plain, set_apart
from a4agent.offline.knowledge import QUALIFIERS, Knowledge, Mention, find, knowledge, stem
from a4agent.offline.noun_phrases import (
    BEFORE_VERBS,
    DETERMINERS,
    GENERIC_PARTS,
    MARKS,
    PREPOSITIONS,
    Noun,
    nouns,
    word_set,
)

_ENABLES = word_set("affords afford affording allows enables permits")
_MODALS = word_set("could would should must might will i you we they")

_HOLD = re.compile(
    r"\b(?:where|which|what|how)\b[^?.!]*\b(?:hold|held|holding|grip|gripped|grasp|grasped|grab|grabbed|pick|take|carry"
    r"|lift|hands?|fingers?|thumb|palm)\b"
    r"|\bwhere (?:could|may|might|should|do) (?:i|you|we|one) touch\b"
    r"|\b(?:hands?|fingers?|thumb|palm|grip|grasp|hold)\b[^?.!]*\b(?:goe?s?|belongs?|rests?|wraps?|be placed|be put)\b"
)
_WHERE_TO_PUT = re.compile(
    r"\bwhere (?:do|does|should|could|would|will|may|might|shall|is|are|to)(?: [\w-]+){0,3} "
    r"(?:pour|put|fill|store|keep|insert|stow|set|set down|lay|place|stand|drop|throw|stack|hang|go|belong|fit|live)\b"
    r"(?! (?:my|the|your) (?:hand|hands|finger|fingers|palm|foot|feet)\b)"
)
_SAFELY = re.compile(r"\b(?:burn|hurt|cut|injur|scald|prick|harm)\w*\b")


@dataclass(frozen=True)
class Verb:
    """A verb as written, without its ending, and the actions it may mean, likeliest first.

    `purpose` marks a verb of a purpose clause: something else is done for it.
    """

    text: str
    base: str
    actions: tuple[str, ...]
    start: int
    end: int
    purpose: bool = False


@dataclass(frozen=True)
class Reading:
    """What a sentence contains: verbs of the main clause, then of its purpose, and separately what it rules out."""

    text: str
    words: tuple[str, ...]
    verbs: tuple[Verb, ...]
    nouns: tuple[Noun, ...]
    unwanted: tuple[Noun, ...] = ()
    unwanted_actions: tuple[str, ...] = ()
    holding: bool = False
    placing: bool = False


def read(instruction: str) -> Reading | None:
    """Take a sentence apart; None if it is in a language that the tables do not cover."""
    text = plain(instruction)
    return None if text is None else parse(text)


def parse(text: str) -> Reading:
    """Take a plain sentence apart, in lower case and spelt right."""
    know = knowledge()
    wanted, ruled_out = set_apart(text)
    main, purpose = main_and_purpose(wanted)
    main, purpose = (joined_verbs(part, know.action_index) for part in (main, purpose))
    words = tokens(main)
    verbs = _verbs(words, know)
    after = tokens(purpose)
    later = [
        replace(verb, start=verb.start + len(words), end=verb.end + len(words), purpose=True)
        for verb in _verbs(after, know)
    ]
    to_put = bool(_WHERE_TO_PUT.search(main)) and not _HOLD.search(main)
    if to_put:
        tools = [noun.thing for noun in nouns(words, _places(verbs), know) if noun.thing and noun.role == "object"]
        to = (*(action for tool in tools for action in tool.uses), "contain", "support")  # a key goes to the lock
        verbs = [replace(verb, base="fill", actions=to) for verb in verbs] or [Verb("put", "put", to, 0, 0)]
    named = nouns(words, _places(verbs), know)
    if to_put:
        named = [noun for noun in named if noun.role != "object" or noun.pronoun]
    more = nouns(after, _places(_verbs(after, know)), know)
    named += [replace(noun, start=noun.start + len(words), end=noun.end + len(words)) for noun in more]
    out = tokens(ruled_out)
    out_verbs = _verbs(out, know)
    unwanted = nouns(out, _places(out_verbs), know)
    if not (verbs or later or named) and out:  # "Don't hold the scissors by the blades"
        things = [noun.owner or noun for noun in unwanted if noun.thing or (noun.owner and noun.owner.thing)]
        verbs, named = out_verbs, [replace(noun, role="object") for noun in things[:1]]
        unwanted = [noun for noun in unwanted if noun.part]
        if not things and any(noun.part for noun in unwanted):  # "avoid the blade"
            verbs = [Verb("hold", "hold", ("grasp",), 0, 0)]
            named = [Noun("object", 0, 0, definite=True, pronoun=True)]
        words, out_verbs = out, []
    named = _resolved(named, unwanted)
    holding = bool(_HOLD.search(main)) or ("without" in ruled_out and bool(_SAFELY.search(ruled_out)))
    actions = tuple(action for verb in out_verbs for action in verb.actions[:1])
    return Reading(
        text,
        (*words, *after),
        (*verbs, *later),
        tuple(named),
        tuple(unwanted),
        actions + _adjectives(out),
        holding,
        to_put,
    )


def _resolved(named: Sequence[Noun], unwanted: Sequence[Noun]) -> list[Noun]:
    """The nouns with "the green one" replaced by what was named before: "not the red button, the green one"."""
    found: list[Noun] = []
    for noun in named:
        before = [n for n in (*unwanted, *found) if n.thing or n.part]
        if noun.pronoun and noun.qualifiers and before:
            noun = replace(before[-1], qualifiers=noun.qualifiers, role=noun.role, start=noun.start, end=noun.end)
        found.append(noun)
    return found


def tokens(text: str) -> list[str]:
    """Words and punctuation marks."""
    return re.findall(r"[a-z0-9]+(?:[-'][a-z0-9]+)*|[,;:.!?]", text)


def _adjectives(ruled_out: Sequence[str]) -> tuple[str, ...]:
    """The actions implied by ruled-out adjectives: the part that is not sharp does not cut."""
    return tuple(action for word in ruled_out for action in knowledge().senses.get(word, ()))


def _verbs(words: Sequence[str], know: Knowledge) -> list[Verb]:
    """The verbs in order; the word before tells them from nouns of the same spelling."""
    found: list[Verb] = []
    named = {
        index
        for mention in know.find_objects(words)
        if mention.end - mention.start > 1
        for index in range(mention.start, mention.end)
    }
    index = 0
    while index < len(words):
        mention = None if index in named else _longest(words, index, know)
        if mention and _is_verb(words, mention, know):
            written = words[mention.start : mention.end]
            text = " ".join(written)
            found.append(Verb(text, know.base_form[stem(written)], mention.value, mention.start, mention.end))
            index = mention.end
        else:
            index += 1
    return found


def _longest(words: Sequence[str], start: int, know: Knowledge) -> Mention[tuple[str, ...]] | None:
    found = find(words[start : start + 4], know.action_index)
    if found and found[0].start == 0:
        return Mention(found[0].value, start, start + found[0].end)
    return None


def _places(verbs: Sequence[Verb]) -> set[int]:
    return {index for verb in verbs for index in range(verb.start, verb.end)}


def _is_verb(words: Sequence[str], mention: Mention[tuple[str, ...]], know: Knowledge) -> bool:
    """Whether words that may be a verb are one here: "scoop sugar", "the hammer hits", "to handle"."""
    before = words[mention.start - 1] if mention.start else "."
    after = words[mention.end] if mention.end < len(words) else "."
    written = tuple(words[mention.start : mention.end])
    gerund = written[0].endswith("ing")
    noun = written in know.nouns
    if written[0].endswith("ed") and written not in know.object_index:
        return before not in DETERMINERS
    if written == ("not",):  # not a note
        return False
    if gerund and before in _ENABLES:
        return True
    if written in (("look",), ("looks",)) and after not in PREPOSITIONS:  # "it looks tasty"
        return False
    if before in _MODALS and mention.start:
        return True
    if before == "to" and words[mention.start - 2] in {"where", "how", "what"}:
        return True
    if gerund and before == "the" and words[mention.start - 2] in {"do", "does"}:  # "the end that does the cutting"
        return True
    if before in PREPOSITIONS or before in {"for", "without", "before", "after"}:
        return gerund or (before == "to" and not (noun and after in MARKS | {"of"}))
    if before in DETERMINERS and before not in {"that", "which", "what"}:
        return False
    if before in QUALIFIERS:
        return False
    if before in {"which", "what"} and written[-1] in GENERIC_PARTS:
        return False
    if before in {"that", "which", "what"}:
        return after not in MARKS or not noun
    if before in BEFORE_VERBS:
        return not noun or (after not in MARKS | {"of", "is", "are", "has"} and stem(after) not in know.part_index)
    return not noun or after in DETERMINERS  # "the pliers grip the wire"
