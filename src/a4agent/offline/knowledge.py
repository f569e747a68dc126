"""Everyday objects, their parts and what the parts are for: `knowledge.toml`, indexed by words.

    know = knowledge()
    know.find_objects(words("pick up the coffee mug"))    -> [Mention(object mug, start=3, end=5)]
    know.objects["mug"].part_named("ear").name            -> "handle"
    know.find_actions(words("tighten it"))                -> [Mention(actions ("fasten",), ...)]

Words are compared without their endings ("cutting", "cuts" and "cut" are one verb), longest phrase first.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Generic, TypeVar

from a4agent.files import read_package_toml

T = TypeVar("T")

COLOURS = (
    "red", "orange", "yellow", "green", "blue", "purple", "pink", "brown", "black", "white", "grey", "beige",
    "silver", "gold", "transparent",
)  # fmt: skip
SIDES = ("left", "right", "upper", "lower", "middle", "front", "back")
SIZES = ("small", "large", "long", "short")

QUALIFIERS = {
    **{name: ("colour", name) for name in COLOURS},
    **{name: ("side", name) for name in SIDES},
    **{name: ("size", name) for name in SIZES},
    "gray": ("colour", "grey"), "violet": ("colour", "purple"), "golden": ("colour", "gold"),
    "clear": ("colour", "transparent"), "steel": ("colour", "silver"), "metal": ("colour", "silver"),
    "cream": ("colour", "beige"), "tan": ("colour", "beige"), "turquoise": ("colour", "blue"),
    "lefthand": ("side", "left"), "left-hand": ("side", "left"), "leftmost": ("side", "left"),
    "righthand": ("side", "right"), "right-hand": ("side", "right"), "rightmost": ("side", "right"),
    "top": ("side", "upper"), "topmost": ("side", "upper"), "uppermost": ("side", "upper"), "higher": ("side", "upper"),
    "bottom": ("side", "lower"), "lowest": ("side", "lower"), "bottommost": ("side", "lower"),
    "low": ("side", "lower"), "high": ("side", "upper"),
    "central": ("side", "middle"), "center": ("side", "middle"), "centre": ("side", "middle"),
    "nearest": ("side", "front"), "closest": ("side", "front"), "rear": ("side", "back"),
    "little": ("size", "small"), "tiny": ("size", "small"), "smaller": ("size", "small"), "smallest": ("size", "small"),
    "big": ("size", "large"), "bigger": ("size", "large"), "biggest": ("size", "large"), "larger": ("size", "large"),
    "largest": ("size", "large"), "huge": ("size", "large"), "tall": ("size", "long"), "taller": ("size", "long"),
    "tallest": ("size", "long"), "longer": ("size", "long"), "longest": ("size", "long"),
    "shorter": ("size", "short"), "shortest": ("size", "short"),
}  # fmt: skip
"""Words that tell one thing from another, as (what they tell, the plain word)."""


@dataclass(frozen=True)
class KnownPart:
    """`shape` says how to find it in a picture and `map` on which of the network's maps, if not its shape's usual one.

    Of two parts that afford an action the first wins.
    """

    name: str
    shape: str
    affords: tuple[str, ...]
    also: tuple[str, ...] = ()
    map: str | None = None

    def is_called(self, *stems: tuple[str, ...]) -> bool:
        """Whether one of these stems is the part's name or another name of it."""
        return any(stem(known) in stems for known in (self.name, *self.also))


@dataclass(frozen=True)
class KnownThing:
    """An object: `uses` is what it is reached for when it is not named, action -> themes ("*": anything).

    `name` is what it is called in the sentence, `key` in knowledge.toml, and `kind` by the network.
    """

    name: str
    also: tuple[str, ...]
    parts: tuple[KnownPart, ...]
    uses: Mapping[str, tuple[str, ...]]
    key: str
    kind: str

    def part_named(self, name: str) -> KnownPart | None:
        """The part of this name or with this other name, in the singular or the plural."""
        exact = next((part for part in self.parts if name == part.name or name in part.also), None)
        key = stem(name)
        return exact or next((part for part in self.parts if part.is_called(key)), None)

    def part_for(self, action: str) -> KnownPart | None:
        """The first part that affords `action`."""
        return next((part for part in self.parts if action in part.affords), None)

    @property
    def working_part(self) -> KnownPart:
        """The first part that does something and is not held, such as a blade; the first of all if there is none."""
        return next((part for part in self.parts if part.affords and "grasp" not in part.affords), self.parts[0])


@dataclass(frozen=True)
class Wish:
    """`says` is a regular expression for what is wrong, `object` and `action` what would help."""

    says: str
    object: str
    action: str


@dataclass(frozen=True)
class Mention(Generic[T]):
    """What `words[start:end]` names."""

    value: T
    start: int
    end: int


@dataclass(frozen=True)
class Knowledge:
    """The tables, and indices from stemmed phrases to what they name; `base_form` is a verb without its ending.

    knowledge.toml explains `instead`, `senses` and `shapes` (by stems).
    """

    objects: Mapping[str, KnownThing]
    object_index: Mapping[tuple[str, ...], str]
    part_index: Mapping[tuple[str, ...], str]
    part_names: frozenset[str]
    action_index: Mapping[tuple[str, ...], tuple[str, ...]]
    theme_index: Mapping[tuple[str, ...], tuple[tuple[str, str], ...]]
    default_index: Mapping[str, tuple[str, ...]]
    wishes: tuple[Wish, ...]
    usual_part: Mapping[tuple[str, ...], str]
    untouchable: frozenset[tuple[str, ...]]
    written: frozenset[str]
    first_part_names: frozenset[str]
    nouns: frozenset[tuple[str, ...]]
    base_form: Mapping[tuple[str, ...], str]
    instead: Mapping[str, Sequence[str]]
    senses: Mapping[str, Sequence[str]]
    shapes: Mapping[tuple[str, ...], str]

    def object_named(self, name: str) -> KnownThing | None:
        """The object of this name or with this other name."""
        known = self.object_index.get(tuple(words(name))) or self.object_index.get(stem(name))
        return self.objects[known] if known else None

    def find_objects(self, words: Sequence[str]) -> list[Mention[KnownThing]]:
        """Objects named in `words`, in order, under the names they have there."""
        found: list[Mention[KnownThing]] = []
        for mention in find(words, self.object_index):
            thing, written = self.objects[mention.value], tuple(words[mention.start : mention.end])
            alike = (name for name in (thing.name, *thing.also) if stem(name) == stem(written))
            name = " ".join(written) if written in self.object_index else next(alike, thing.name)
            found.append(Mention(replace(thing, name=name), mention.start, mention.end))
        return found

    def find_parts(self, words: Sequence[str]) -> list[Mention[str]]:
        """Parts named in `words`, as they are called there without endings."""
        return find(words, self.part_index)

    def find_actions(self, words: Sequence[str]) -> list[Mention[tuple[str, ...]]]:
        """Verbs in `words` and the actions each may mean."""
        return find(words, self.action_index)

    def find_themes(self, words: Sequence[str]) -> list[Mention[tuple[tuple[str, str], ...]]]:
        """Things that tools are used on, each with its (action, object) pairs."""
        return find(words, self.theme_index)


@lru_cache(maxsize=1)
def knowledge() -> Knowledge:
    """The knowledge base, read once."""
    table = read_package_toml("a4agent.offline", "knowledge.toml")
    objects = {name: _thing(name, row, table) for name, row in table["objects"].items()}
    names = [(name, thing.name) for thing in objects.values() for name in (thing.name, *thing.also)]
    # Names as they are written come before their stems: "glasses" are not "glass".
    object_index = {stem(name): thing for name, thing in reversed(names)} | {tuple(words(n)): t for n, t in names}
    part_names = {name for thing in objects.values() for part in thing.parts for name in (part.name, *part.also)}
    actions: dict[tuple[str, ...], list[str]] = {}
    for action, verbs in table["actions"].items():
        for verb in dict.fromkeys((action, *verbs)):
            actions.setdefault(stem(verb), []).append(action)
    for verb, named in actions.items():
        named.sort(key=lambda action: stem(action) != verb)
    themes: dict[tuple[str, ...], list[tuple[str, str]]] = {}
    defaults: dict[str, list[str]] = {}
    for thing in objects.values():
        for action, names in thing.uses.items():
            for name in names:
                if name == "*":
                    defaults.setdefault(action, []).append(thing.name)
                else:
                    themes.setdefault(stem(name), []).append((action, thing.name))
    spoken_names = [
        *(name for thing in objects.values() for name in (thing.name, *thing.also)),
        *(theme for thing in objects.values() for names in thing.uses.values() for theme in names),
    ]
    spoken = [
        *spoken_names,
        *part_names,
        *(verb for action, verbs in table["actions"].items() for verb in (action, *verbs)),
    ]
    unknown = dict(table["unknown"])
    untouchable = frozenset(stem(name) for name in unknown.pop("untouchable"))
    return Knowledge(
        objects=objects,
        object_index=object_index,
        part_index={stem(name): name for name in sorted(part_names)},
        part_names=frozenset(part_names),
        action_index={verb: tuple(found) for verb, found in actions.items()},
        theme_index={name: tuple(found) for name, found in themes.items()},
        default_index={action: tuple(found) for action, found in defaults.items()},
        wishes=tuple(Wish(**row) for row in table["wishes"]),
        usual_part={stem(verb): part for part, verbs in unknown.items() for verb in verbs},
        untouchable=untouchable,
        instead=table["instead"],
        senses=table["senses"],
        shapes={stem(name): shape for shape, names in table["shapes"].items() for name in names},
        base_form={stem(verb): verb for action, verbs in table["actions"].items() for verb in (action, *verbs)},
        nouns=frozenset(
            (*name[:-1], name[-1] + ending)
            for name in {tuple(words(name)) for name in [*spoken_names, *part_names]} - {("*",), ()}
            for ending in ("", "s", "es")
        ),
        first_part_names=frozenset(part.name for thing in objects.values() for part in thing.parts),
        written=frozenset(word for phrase in spoken for word in words(phrase)),
    )


def _thing(name: str, row: Mapping[str, Any], table: Mapping[str, Any]) -> KnownThing:
    """An object with its own parts first, then its family's that it does not rename."""
    family = table["families"][row["family"]] if "family" in row else {}
    own = [_part(part, spec) for part, spec in row.get("parts", {}).items()]
    taken = {known for part in own for known in (part.name, *part.also)}
    shared = [_part(part, spec) for part, spec in family.get("parts", {}).items() if part not in taken]
    shared = [replace(part, also=tuple(known for known in part.also if known not in taken)) for part in shared]
    return KnownThing(
        name=name,
        also=tuple(row.get("also", ())),
        parts=(*own, *shared),
        uses={action: tuple(names) for action, names in row.get("uses", {}).items()},
        key=name,
        kind=row.get("kind") or family.get("kind") or name,
    )


def _part(name: str, row: Mapping[str, Any]) -> KnownPart:
    return KnownPart(name, row["shape"], tuple(row["affords"]), tuple(row.get("also", ())), row.get("map"))


_WORDS = re.compile(r"[a-z0-9]+(?:[-'][a-z0-9]+)*")


def words(text: str) -> list[str]:
    """The words of a text, lower case, without punctuation."""
    if text.isascii() and text.islower() and text.replace(" ", "").isalpha():  # most names: no need to search
        return text.split()
    return _WORDS.findall(text.lower().replace("’", "'"))


def stem(phrase: str | Iterable[str]) -> tuple[str, ...]:
    """The words of a phrase without their endings: "picked up" -> ("pick", "up")."""
    listed = words(phrase) if isinstance(phrase, str) else phrase
    return tuple(_stem(word) for word in listed)


_IRREGULAR = {
    "held": "hold", "took": "tak", "taken": "tak", "gave": "giv", "given": "giv", "broke": "break", "drank": "drink",
    "ate": "eat", "eaten": "eat", "dug": "dig", "swept": "sweep", "wrote": "writ", "written": "writ", "drew": "draw",
    "threw": "throw", "sat": "sit", "lay": "li", "hung": "hang", "shut": "shut", "knives": "knif", "leaves": "leaf",
    "lying": "li", "driven": "driv", "drove": "driv", "worn": "wear", "wore": "wear", "sewn": "sew", "teeth": "teeth",
    "tied": "ti", "tying": "ti", "men": "man", 
    "goes": "go", "does": "do", "went": "go", "loaves": "loaf", "shelves": "shelf", "halves": "halv",
}  # fmt: skip


@lru_cache(maxsize=4096)
def _stem(word: str) -> str:
    """A light stemmer: plurals, -ing, -ed and a final e go; double consonants before them become single."""
    word = word.removesuffix("'s").removesuffix("'")
    if word in _IRREGULAR:
        return _IRREGULAR[word]
    if len(word) > 4 and word.endswith("ies"):
        word = word[:-3] + "y"
    elif len(word) > 4 and word.endswith(("sses", "shes", "ches", "xes", "zes")):
        word = word[:-2]
    elif len(word) > 3 and word.endswith("s") and not word.endswith(("ss", "us", "is")):
        word = word[:-1]
    for ending in ("ing", "ed"):
        base = word.removesuffix(ending)
        if base != word and len(base) > 2 and re.search("[aeiouy]", base):
            word = base[:-1] if base[-1] == base[-2] and base[-1] not in "lsz" else base
            break
    word = word[:-1] if len(word) > 3 and word.endswith("e") else word
    return word[:-1] + "i" if len(word) > 3 and word.endswith("y") and word[-2] not in "aeiou" else word


def find(listed: Sequence[str], index: Mapping[tuple[str, ...], T]) -> list[Mention[T]]:
    """The longest phrases of `index` in `listed`, left to right, not overlapping."""
    stems = stem(listed)
    longest = max(map(len, index), default=0)
    found: list[Mention[T]] = []
    start = 0
    while start < len(stems):
        for length in range(min(longest, len(stems) - start), 0, -1):
            written, key = tuple(listed[start : start + length]), stems[start : start + length]
            if written in index or key in index:
                found.append(Mention(index[written if written in index else key], start, start + length))
                start += length - 1
                break
        start += 1
    return found
