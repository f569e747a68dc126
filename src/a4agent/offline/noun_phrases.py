"""Noun phrases: which thing or part they name, which one of several, whose it is, and after which preposition.

nouns(["take", "the", "black", "mug", "by", "its", "handle"], {0}, know)
-> [Noun("mug", qualifiers=("black",), thing=...), Noun("handle", role="aim", part="handle")]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from a4agent.offline.clauses import DEFINITE
from a4agent.offline.knowledge import QUALIFIERS, Knowledge, KnownThing, Mention, stem

Role = Literal["object", "tool", "place", "goal", "owner", "aim"]


def word_set(words: str) -> frozenset[str]:
    return frozenset(words.split())


GENERIC_PARTS = word_set("part parts end side bit piece portion section area region component element spot place")
MARKS = frozenset(",;:.!?")
DETERMINERS = DEFINITE | word_set("a an some any all both each either every another no two three such what which")
_PRONOUNS = word_set("it this that these those them something anything everything thing things one ones stuff")
BEFORE_VERBS = word_set(
    "to could would will should must might may and or then not do does did never be is are was were been let i you we "
    "they he she it who which that what used supposed meant able "
    "affords afford affording allows enables permits often usually also "
    "only first , ; : . ! ?"
)
_PLACES = word_set(
    "to toward towards from off out near next beside behind below beneath under underneath above over between "
    "against around across along within outside through"
)
PREPOSITIONS: dict[str, Role] = {
    **dict.fromkeys(("with", "using", "use", "uses", "via"), "tool"),
    **dict.fromkeys(_PLACES, "place"),
    **dict.fromkeys(("in", "into", "inside", "on", "onto", "upon"), "goal"),
    "by": "aim",
    "at": "aim",
    "of": "owner",
}
_STOP_WORDS = (DEFINITE | DETERMINERS | _PRONOUNS | BEFORE_VERBS | frozenset(PREPOSITIONS)) - word_set(
    "thing things stuff one ones"
) | word_set(
    """
about after again ahead am apart are as aside away be because been before being but come comes coming down
each for go goes going gone had has have having here him how if just like liked likes made make makes me meanwhile meant
need needed needs now once other ought out please same shall she since so soon suitable supposed than there therefore
together too until up upon us very want wanted wants well when where wherever whether while whose why will without yes
yet your really around able ready touch
"""
)


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
    thing: KnownThing | None = None
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


_MINE = word_set("my your his her")
_SOME = word_set("one each either any some both all")
_REMOVABLE = word_set("cap lid top cover cork stopper")
_OF_PEOPLE = word_set("hand hands finger fingers thumb palm foot feet grip way time")
"""What is not in the picture as a thing to act on."""
_TOOLS = word_set("tool instrument utensil")
_PRONOUN_NOUNS = word_set("one ones thing things stuff object item tool gadget device") | {""}
"""Nouns that name no kind of thing; "" is a phrase of qualifiers alone."""
_OF_BODIES = word_set(
    "mouth lip lips head neck arm arms leg legs back face teeth foot feet ear ears nose hair hairs shoulder"
)


def nouns(words: list[str], in_verb: set[int], know: Knowledge) -> list[Noun]:
    """The noun phrases in order, owners attached: "the handle of the mug" is one; `in_verb` are the places of verbs."""
    found: list[Noun] = []
    role: Role = "object"
    index = 0
    while index < len(words):
        word = words[index]
        after = words[index + 1] if index + 1 < len(words) else "."
        if (word in _SOME and after == "of") or (
            word in _MINE and after in _OF_BODIES
        ):  # "one of the lids", "my mouth"
            index += 2
        elif index in in_verb or word in MARKS:
            role, index = "object", index + 1
        elif word in PREPOSITIONS and not (word == "to" and index + 1 in in_verb):
            role, index = PREPOSITIONS[word], index + 1
        else:
            phrase = _phrase(words, index, in_verb, know)
            if phrase is None:
                index += 1
                continue
            if role == "owner" and found and found[-1].generic:
                phrase = _without_verb(phrase, words)
            if phrase.text in GENERIC_PARTS and words[phrase.end : phrase.end + 1] in (["that"], ["which"]):
                phrase = replace(phrase, part=None)  # "the end that cuts"
            if phrase.pronoun and phrase.qualifiers and words[index - 1] in {"is", "are"}:  # "the mug that is blue"
                role = "place"
            index = phrase.end
            _add(found, replace(phrase, role=role), role)
            role = "object"
    return found


def _without_verb(noun: Noun, words: Sequence[str]) -> Noun:
    """An unknown thing without the verb after it: "(which part of) the ferrule touches the rod"."""
    said = noun.text.split()
    verb = len(said) > 1 and said[-1].endswith("s") and words[noun.end : noun.end + 1] and noun.thing is None
    goes_on = verb and words[noun.end] in (DETERMINERS | frozenset(PREPOSITIONS))
    return replace(noun, text=" ".join(said[:-1]), end=noun.end - 1) if goes_on else noun


def _add(found: list[Noun], noun: Noun, role: Role) -> None:
    """Append a noun, or make it the owner of the part before."""
    last = found[-1] if found else None
    if last and last.role != "aim" and _says_which_one(noun, role):  # "the drawer on the left", "with the blue stripes"
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
        fits = fits or (role == "place" and last.part in _REMOVABLE and noun.thing is not None)
        if last.part and (of or fits) and not (last.thing and not fits):
            found[-1] = replace(last, owner=noun, thing=None, end=noun.end)
            return
        itself = last.thing is not None and last.thing.part_named(last.text) is not None  # a lever, a knob, a shelf
        named = last.definite and noun.thing is None and noun.start == last.end + 1
        if of and (itself or (named and not last.thing and not last.part and not last.pronoun)):
            found[-1] = replace(last, part=last.text, owner=noun, thing=None, end=noun.end)
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
    if noun.thing or noun.owner or (role == "owner" and not noun.pronoun):
        return False
    side = noun.pronoun or noun.text in {"side", "end", "corner", "hand side"}
    return (side and bool(noun.qualifiers) and role != "object") or (noun.text in QUALIFIERS and role != "object")


def _merged(first: Sequence[str], more: Sequence[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys([*first, *more]))


def _phrase(words: list[str], start: int, in_verb: set[int], know: Knowledge) -> Noun | None:
    """The noun phrase that starts at a word."""
    index = start
    while index < len(words) and words[index] in DETERMINERS and index not in in_verb:
        index += 1
    definite = any(word in DEFINITE or word == "any" for word in words[start:index])
    end = index + (index > start and words[index : index + 1] == ["inside"])
    while end < len(words) and end not in in_verb and words[end] not in _STOP_WORDS and words[end] not in MARKS:
        end += 1
    if "back" in words[index + 1 : end]:  # "put the lid back on"
        end = words.index("back", index + 1)
    run = words[index:end]
    after = words[start + 1] if start + 1 < len(words) else "."
    if words[start] == "that" and (start + 1 in in_verb or after in BEFORE_VERBS - MARKS or after in {"has", "can"}):
        return None  # "the mug that is blue"
    if index == start and not run and words[start] in {"something", "anything"}:
        return None
    if run == ["one"] and (end in in_verb or not definite):  # "where does one sit"
        return None
    if not run:
        alone = Noun("object", start, max(index, start + 1), definite=True, pronoun=True)
        return alone if words[start] in _PRONOUNS else None
    for place, word in enumerate(run):
        if word.endswith(("'s", "s'")):
            owner = _named(run[: place + 1], index, True, know, possessive=True)
            rest = _named(run[place + 1 :], index + place + 1, True, know)
            return replace(rest, owner=owner or rest.owner, start=start) if rest else owner
    noun = _named(run, index, definite, know, asked=bool({"which", "what"} & set(words[start:index])))
    return replace(noun, start=start) if noun else None


def _named(
    run: Sequence[str], at: int, article: bool, know: Knowledge, *, possessive: bool = False, asked: bool = False
) -> Noun | None:
    """What a run of words names: the last known thing, a part of it right after, or the words themselves."""
    if not run:
        return None
    words = [word.removesuffix("'s").removesuffix("'") for word in run] if possessive else list(run)
    if asked and words[0] in GENERIC_PARTS and len(words) == 2 and words[1].endswith("s"):  # "which end bites"
        return Noun(words[0], at, at + 2, definite=True)
    if asked and words[-1] in GENERIC_PARTS:
        return Noun(" ".join(words), at, at + len(words), definite=True)
    things = know.find_objects(words)
    parts = [p for p in know.find_parts(words) if not _only_qualifies(words, p) and not _is_only_a_verb(words, p, know)]
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
    kept = [
        word
        for word in words
        if word not in QUALIFIERS and word not in ("far", "very") and not (word.endswith("ly") and len(word) > 4)
    ]
    last = kept[-1] if kept else ""
    if last in _OF_PEOPLE or (last in _TOOLS and not article):
        return None
    pronoun = last in _PRONOUN_NOUNS
    text = "object" if pronoun else " ".join(kept[:4])
    return Noun(text, at, at + len(words), qualifiers=_qualifiers(words), definite=article, pronoun=pronoun)


def _part_of(words: Sequence[str], thing: Mention[KnownThing], start: int, end: int, at: int) -> Noun:
    owner = Noun(thing.value.name, at, at + thing.end, thing=thing.value, qualifiers=_qualifiers(words[: thing.start]))
    text = " ".join(words[start:end])
    return Noun(text, at, at + end, part=text, owner=owner, definite=True)


def _is_only_a_verb(words: Sequence[str], part: Mention[str], know: Knowledge) -> bool:
    """Whether a word only shares its stem with a part: "open" is no opening."""
    written = tuple(words[part.start : part.end])
    return written not in know.nouns and stem(written) in know.action_index


def _only_qualifies(words: Sequence[str], part: Mention[str]) -> bool:
    """Whether a word like "top" says which one: "the top drawer"."""
    return part.end < len(words) and all(word in QUALIFIERS for word in words[part.start : part.end])


def _qualifiers(words: Sequence[str]) -> tuple[str, ...]:
    """The plain qualifiers in some words: "big", "yellow-handled" -> ("large", "yellow")."""
    plain = (word.split("-")[0] if word not in QUALIFIERS else word for word in words)
    return tuple(dict.fromkeys(QUALIFIERS[word][1] for word in plain if word in QUALIFIERS))
