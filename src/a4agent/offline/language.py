"""English sentences as far as the offline Thinker needs them: spelling, verbs, noun phrases, what is ruled out.

    read("Could you please pikc up the black mug by its handle, not by the rim?")
    -> Reading(verbs=(pick up,), nouns=(black mug, handle), unwanted=(rim,), ...)

The steps, each a short function: contractions and polite frames go; words that nobody knows are matched with the
words of knowledge.toml by edit distance; what follows "not", "without" or "instead of" is set apart; so is the
purpose ("so that ...", "to ..."); the word before tells a verb from a noun; what is left are noun phrases.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

from a4agent.offline.clauses import DEFINITE, joined_verbs, main_and_purpose, plain, set_apart
from a4agent.offline.knowledge import QUALIFIERS, Knowledge, Mention, Thing, find, knowledge, stem

T = TypeVar("T")

Role = Literal["object", "tool", "place", "goal", "owner", "aim"]


def _set(words: str) -> frozenset[str]:
    return frozenset(words.split())


GENERIC_PARTS = _set("part parts end side bit piece portion section area region component element spot place")
MARKS = frozenset(",;:.!?")
_DETERMINERS = DEFINITE | _set("a an some any all both each either every another no two three such what which")
_PRONOUNS = _set("it this that these those them something anything everything thing things one ones stuff")
_BEFORE_VERBS = _set(
    "to could would will should must might may and or then not do does did never be is are was were been let i you we "
    "they he she it who which that what used supposed meant able often usually also only first , ; : . ! ?"
)
_MODALS = _set("could would should must might will i you we they")
_PREPOSITIONS: dict[str, Role] = {
    **dict.fromkeys(("with", "using", "use", "uses", "via"), "tool"),
    **dict.fromkeys(
        [
            "on",
            "to",
            "toward",
            "towards",
            "from",
            "off",
            "out",
            "near",
            "next",
            "beside",
            "behind",
            "below",
            "beneath",
            "under",
            "underneath",
            "above",
            "over",
            "between",
            "against",
            "around",
            "across",
            "along",
            "within",
            "outside",
            "through",
            "below",
        ],
        "place",
    ),
    **dict.fromkeys(("in", "into", "inside", "onto"), "goal"),
    "by": "aim",
    "at": "aim",
    "of": "owner",
}
_STOP_WORDS = (DEFINITE | _DETERMINERS | _PRONOUNS | _BEFORE_VERBS | frozenset(_PREPOSITIONS)) - _set(
    "thing things stuff one ones"
) | _set(
    """
about after again ahead am apart are as aside away back be because been before being but come comes coming down
each for go goes going gone had has have having here him how if just like liked likes made make makes me meanwhile meant
need needed needs now once other ought out please same shall she since so soon suitable supposed than there therefore
together too until up upon us very want wanted wants well when where wherever whether while whose why will without yes
yet your really around able ready
"""
)

_HOLD = re.compile(
    r"\b(?:where|which|what|how)\b[^?.!]*\b(?:hold|held|holding|grip|grasp|grasped|grab|touch|pick|take|carry|lift|hand|hands"
    r"|finger|fingers|palm)\b"
    r"|\b(?:hand|hands|fingers?|palm|grip|grasp|hold)\b[^?.!]*\b(?:go|goes|belongs?|rests?|wraps?|be placed|be put)\b"
)
_WHERE_TO_PUT = re.compile(
    r"\bwhere (?:do|does|should|could|would|will|is|are|to)(?: \w+){0,2} (?:pour|put|fill|store|keep|insert|stow)\b"
    r"(?! (?:my|the|your) (?:hand|hands|finger|fingers|palm|foot|feet)\b)"
)
_SAFELY = re.compile(r"\b(?:burn|hurt|cut|injur|scald|prick|harm)\w*\b")


@dataclass(frozen=True)
class Noun:
    """A noun phrase: a known thing, a known part, or words that are neither; `owner` as in "the handle of the mug".

    `text` is without article and qualifiers; `qualifiers` are the plain words of QUALIFIERS ("black", "left"); `role`
    comes from the preposition before it.
    """

    text: str
    start: int
    end: int
    role: Role = "object"
    thing: Thing | None = None
    part: str | None = None
    qualifiers: tuple[str, ...] = ()
    owner: Noun | None = None
    definite: bool = False
    pronoun: bool = False

    @property
    def name(self) -> str:
        """The words for a phrase: "black mug"."""
        return " ".join((*self.qualifiers, self.text))

    @property
    def generic(self) -> bool:
        """Whether this is "the part" of something, whichever that may be."""
        return (
            self.definite
            and self.part is None
            and self.thing is None
            and self.text.rsplit(" ", maxsplit=1)[-1] in GENERIC_PARTS
        )


@dataclass(frozen=True)
class Verb:
    """A verb as written, without its ending, and the actions it may mean, likeliest first.

    `purpose` tells that something else is done for it.
    """

    text: str
    base: str
    actions: tuple[str, ...]
    start: int
    end: int
    purpose: bool = False


@dataclass(frozen=True)
class Reading:
    """What a sentence holds: verbs of the main clause first, then those of its purpose; what it rules out apart."""

    text: str
    words: tuple[str, ...]
    verbs: tuple[Verb, ...]
    nouns: tuple[Noun, ...]
    unwanted: tuple[Noun, ...] = ()
    unwanted_actions: tuple[str, ...] = ()
    holding: bool = False


def read(instruction: str) -> Reading | None:
    """Take a sentence apart; None if it is in a language that the tables do not cover."""
    know = knowledge()
    text = plain(instruction)
    if text is None:
        return None
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
        verbs = [replace(verb, base="fill", actions=("contain",)) for verb in verbs]
    nouns = _nouns(words, verbs, know)
    if to_put:
        nouns = [noun for noun in nouns if noun.role != "object" or noun.pronoun]
    more = _nouns(after, _verbs(after, know), know)
    nouns += [replace(noun, start=noun.start + len(words), end=noun.end + len(words)) for noun in more]
    out = tokens(ruled_out)
    out_verbs = _verbs(out, know)
    unwanted = _nouns(out, out_verbs, know)
    if not (verbs or later or nouns) and out:  # "Don't hold the scissors by the blades"
        things = [noun for noun in unwanted if noun.thing]
        verbs, nouns = out_verbs, things[:1]
        unwanted = [noun for noun in unwanted if noun not in nouns]
        words, out_verbs = out, []
    holding = bool(_HOLD.search(main)) or ("without" in ruled_out and bool(_SAFELY.search(ruled_out)))
    actions = tuple(action for verb in out_verbs for action in verb.actions[:1])
    return Reading(
        text, (*words, *after), (*verbs, *later), tuple(nouns), tuple(unwanted), actions + _adjectives(out), holding
    )


def tokens(text: str) -> list[str]:
    """Words and punctuation marks."""
    return re.findall(r"[a-z0-9]+(?:[-'][a-z0-9]+)*|[,;:.!?]", text)


def _adjectives(ruled_out: Sequence[str]) -> tuple[str, ...]:
    """Actions that ruled-out adjectives stand for: the part that is not sharp does not cut."""
    return tuple(action for word in ruled_out for action in SENSES.get(word, ()))


SENSES = {
    "sharp": ("cut",), "hot": ("cook",), "pointed": ("spear",), "pointy": ("spear",), "spiky": ("spear",),
    "hollow": ("contain",),
}  # fmt: skip
"""What a part of such a look is there for."""


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
        mention = None if index in named else _longest(words, index, know.action_index)
        if mention and _is_verb(words, mention, know):
            written = words[mention.start : mention.end]
            text = " ".join(written)
            found.append(Verb(text, know.base_form[stem(written)], mention.value, mention.start, mention.end))
            index = mention.end
        else:
            index += 1
    return found


def _longest(words: Sequence[str], start: int, index: Mapping[tuple[str, ...], T]) -> Mention[T] | None:
    found = find(words[start : start + 4], index)
    if found and found[0].start == 0:
        return Mention(found[0].value, start, start + found[0].end)
    return None


def _is_verb(words: Sequence[str], mention: Mention[tuple[str, ...]], know: Knowledge) -> bool:
    """Whether words that may be a verb are one here: "scoop sugar", "the hammer hits", "to handle"."""
    before = words[mention.start - 1] if mention.start else "."
    after = words[mention.end] if mention.end < len(words) else "."
    written = tuple(words[mention.start : mention.end])
    key = stem(written)
    gerund = written[0].endswith("ing")
    noun = (key in know.object_index or key in know.part_index or key in know.theme_index) and not (
        gerund and written not in know.object_index
    )
    if written[0].endswith("ed") and written not in know.object_index:
        return before not in _DETERMINERS
    if written == ("not",):  # not a note
        return False
    if before in _MODALS and mention.start:
        return True
    if before in _PREPOSITIONS or before in {"for", "without", "before", "after"}:
        return gerund or (before == "to" and not (noun and after in MARKS | {"of"}))
    if before in _DETERMINERS and before not in {"that", "which", "what"}:
        return False
    if before in QUALIFIERS:
        return False
    if before in {"which", "what"} and written[-1] in GENERIC_PARTS:
        return False
    if before in {"that", "which", "what"}:
        return after not in MARKS or not noun
    if before in _BEFORE_VERBS:
        return not noun or (after not in MARKS | {"of", "is", "are", "has"} and stem(after) not in know.part_index)
    return not noun


_OF_PEOPLE = _set("hand hands finger fingers thumb palm foot feet grip way time")
"""What is not in the picture as a thing to act on."""


def _nouns(words: list[str], verbs: Sequence[Verb], know: Knowledge) -> list[Noun]:
    """The noun phrases in order, owners attached: "the handle of the mug" is one."""
    in_verb = {index for verb in verbs for index in range(verb.start, verb.end)}
    found: list[Noun] = []
    role: Role = "object"
    index = 0
    while index < len(words):
        word = words[index]
        if index in in_verb or word in MARKS:
            role, index = "object", index + 1
        elif word in _PREPOSITIONS and not (word == "to" and index + 1 in in_verb):
            role, index = _PREPOSITIONS[word], index + 1
        else:
            phrase = _phrase(words, index, in_verb, know)
            if phrase is None:
                index += 1
                continue
            index = phrase.end
            _add(found, replace(phrase, role=role), role)
            role = "object"
    return found


def _add(found: list[Noun], noun: Noun, role: Role) -> None:
    """Append a noun, or make it the owner of the part before."""
    last = found[-1] if found else None
    if last and last.part is None and _says_which_one(noun, role):  # "the drawer on the left", "with the blue stripes"
        found[-1] = replace(last, qualifiers=_merged(last.qualifiers, noun.qualifiers or _qualifiers([noun.text])))
        return
    if last and role in ("owner", "place", "goal") and noun.start - last.end <= 3 and last.owner is None:
        of = role == "owner"
        if last.pronoun and last.qualifiers and of and noun.thing:  # "the smaller one of the two mugs"
            found[-1] = replace(noun, qualifiers=_merged(last.qualifiers, noun.qualifiers), role=last.role)
            return
        if last.text.split()[-1] in GENERIC_PARTS and of:
            found[-1] = replace(last, owner=noun, end=noun.end)
            return
        fits = noun.thing is not None and last.part is not None and noun.thing.part_named(last.part)
        if last.part and (of or fits) and not (last.thing and not fits):
            found[-1] = replace(last, owner=noun, thing=None, end=noun.end)
            return
        if of and last.thing is None and last.part is None and noun.thing:  # "a picture of the mug"
            found[-1] = replace(noun, role=last.role)
            return
        if of:
            return
    found.append(noun)


def _says_which_one(noun: Noun, role: Role) -> bool:
    """Whether a noun after a preposition only tells which thing is meant."""
    if role == "tool":
        return bool(noun.qualifiers) and noun.thing is None and noun.part is None and not noun.pronoun
    if role == "owner" or noun.thing or noun.owner:
        return False
    return (noun.pronoun and bool(noun.qualifiers)) or (noun.text in QUALIFIERS and role != "object")


def _merged(first: Sequence[str], more: Sequence[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys([*first, *more]))


def _phrase(words: list[str], start: int, in_verb: set[int], know: Knowledge) -> Noun | None:
    """The noun phrase that starts at a word."""
    index = start
    while index < len(words) and words[index] in _DETERMINERS and index not in in_verb:
        index += 1
    definite = any(word in DEFINITE for word in words[start:index])
    end = index
    while end < len(words) and end not in in_verb and words[end] not in _STOP_WORDS and words[end] not in MARKS:
        end += 1
    run = list(words[index:end])
    if words[start:index] == [] and run == [] and words[start] in {"something", "anything"}:
        return None
    if run == ["one"] and (end in in_verb or not definite):  # "where does one sit"
        return None
    if not run:
        single = words[start : start + 1]
        if (index > start and single[0] in _PRONOUNS) or (single[0] in _PRONOUNS and index == start):
            return Noun("object", start, max(index, start + 1), definite=True, pronoun=True)
        return None
    for place, word in enumerate(run):
        if word.endswith(("'s", "s'")):
            owner = _named(run[: place + 1], index, True, know, possessive=True)
            rest = _named(run[place + 1 :], index + place + 1, True, know)
            if rest is None:
                return owner
            return replace(rest, owner=owner, start=start) if owner else replace(rest, start=start)
    noun = _named(run, index, definite, know, asked=bool({"which", "what"} & set(words[start:index])))
    return replace(noun, start=start) if noun else None


def _named(
    run: Sequence[str], at: int, article: bool, know: Knowledge, *, possessive: bool = False, asked: bool = False
) -> Noun | None:
    """What a run of words names: the last known thing, a part of it right after, or the words themselves."""
    if not run:
        return None
    words = [word.removesuffix("'s").removesuffix("'") for word in run] if possessive else list(run)
    if asked and words[-1] in GENERIC_PARTS:
        return Noun(" ".join(words), at, at + len(words), definite=True)
    things = know.find_objects(words)
    parts = [p for p in know.find_parts(words) if not _only_qualifies(words, p)]
    if things:
        thing = things[-1]
        for other in things[:-1]:  # "door handle", "bottle cap"
            if other.end == thing.start and other.value.part_named(thing.value.name):
                return _part_of(words, other, thing.start, thing.end, at)
        following = [p for p in parts if p.start >= thing.end]
        if following and following[0].start == thing.end:
            return _part_of(words, thing, following[0].start, following[0].end, at)
        covered = [p for p in parts if p.start <= thing.start and p.end >= thing.end]
        end = thing.end
        return Noun(
            thing.value.name,
            at,
            at + end,
            thing=thing.value,
            part=covered[-1].value if covered and not _qualifiers(words[: thing.start]) else None,
            qualifiers=_qualifiers(words[: thing.start]),
            definite=article,
        )
    if parts:
        part = parts[-1]
        between = [word for word in words[: part.start] if word not in QUALIFIERS]
        text = " ".join([*between, *words[part.start : part.end]])
        return Noun(
            text, at, at + part.end, part=part.value, qualifiers=_qualifiers(words[: part.start]), definite=article
        )
    kept = [word for word in words if word not in QUALIFIERS and not (word.endswith("ly") and len(word) > 4)]
    if not kept or kept[-1] in _OF_PEOPLE:
        return (
            None
            if kept
            else Noun("object", at, at + len(words), pronoun=True, qualifiers=_qualifiers(words), definite=article)
        )
    if kept[-1] in {"tool", "instrument", "utensil"} and not article:
        return None
    if kept[-1] in {"one", "ones", "thing", "things", "stuff", "object", "item", "tool", "gadget", "device"}:
        return Noun("object", at, at + len(words), pronoun=True, qualifiers=_qualifiers(words), definite=article)
    if kept[-1] in GENERIC_PARTS and not article:
        return Noun(" ".join(kept[:4]), at, at + len(words), qualifiers=_qualifiers(words))
    return Noun(" ".join(kept[:4]), at, at + len(words), qualifiers=_qualifiers(words), definite=article)


def _part_of(words: Sequence[str], thing: Mention[Thing], start: int, end: int, at: int) -> Noun:
    owner = Noun(thing.value.name, at, at + thing.end, thing=thing.value, qualifiers=_qualifiers(words[: thing.start]))
    text = " ".join(words[start:end])
    return Noun(text, at, at + end, part=text, owner=owner, definite=True)


def _only_qualifies(words: Sequence[str], part: Mention[str]) -> bool:
    """Whether a word like "top" says which one: "the top drawer"."""
    return part.end < len(words) and all(word in QUALIFIERS for word in words[part.start : part.end])


def _qualifiers(words: Sequence[str]) -> tuple[str, ...]:
    """The plain qualifiers in some words: "big", "yellow-handled" -> ("large", "yellow")."""
    plain = (word.split("-")[0] if word not in QUALIFIERS else word for word in words)
    return tuple(dict.fromkeys(QUALIFIERS[word][1] for word in plain if word in QUALIFIERS))
