"""What a phrase asks the detector for: which part, of which kind of thing, and which one of several.

The phrases are those that the reasoner writes and a person may type:

    "the handle of the black mug"      Wanted(part="grip", object="mug", kind="mug", colour="black")
    "the handle of the left drawer"    Wanted(part="grip", object="drawer", kind="drawer", side="left")
    "the left handle of the pan"       Wanted(part="grip", object="pan", kind="pan", part_side="left")
    "the red button of the machine"    Wanted(part="control", part_colour="red")
    "the blade of the spatula"         Wanted(part="work", object="spatula", kind="turner")
    "the part that can cut"            Wanted(part="work", action="cut"): of whatever is in the picture
    "the mug"                          Wanted(part="whole", object="mug", kind="mug")
    "the handle of the frobnicator"    Wanted(part="grip"): a thing that the knowledge base does not hold
    "cut the bread"                    as the reasoner answers: the blade of a knife

A phrase is `the [QUALIFIERS] PART of the [QUALIFIERS] OBJECT`. PART is a name in knowledge.toml, or "part that can
VERB" where nobody named a part; OBJECT is a name in knowledge.toml, or "object" where nobody named a thing. Qualifiers
are one of COLOURS, SIDES or SIZES each.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

from a4agent.offline.decisions import decide
from a4agent.offline.knowledge import QUALIFIERS, KnownThing, knowledge, stem, words

PARTS = ("grip", "work", "body", "inside", "control", "lid", "spout", "whole")
"""The part maps of the network, and "whole"."""


@dataclass(frozen=True)
class Wanted:
    """`part` is one of PARTS; `object` a name in knowledge.toml and `kind` what the network calls such a thing.

    `colour`, `side` and `size` tell things apart, `part_colour` and `part_side` the parts of one thing. `shape` is one
    of SHAPES.
    """

    shape: str
    part: str = "whole"
    object: str | None = None
    kind: str | None = None
    colour: str | None = None
    side: str | None = None
    size: str | None = None
    part_colour: str | None = None
    part_side: str | None = None
    action: str | None = None


SHAPES = (
    "whole", "grip", "work", "tip", "loop", "arm", "spout", "body", "opening", "rim",
    "top", "middle", "lower", "bottom", "bar", "spot", "handle",
)  # fmt: skip

_PLACE = re.compile(
    r" (?:below|under|underneath|beneath|above|over|on|onto|in|inside|at|by|near|next|beside|behind|between|against"
    r"|from|to|that|which|with) "
)


_PART_MAPS = {
    "whole": "whole", "grip": "grip", "arm": "grip", "loop": "grip", "bar": "grip", "handle": "grip",
    "work": "work", "tip": "work", "spout": "spout", "opening": "inside", "spot": "control", "top": "lid",
    "body": "body", "rim": "body", "middle": "body", "lower": "body", "bottom": "body",
}  # fmt: skip
"""The network's part map for each shape, where knowledge.toml names none."""

_THAT_CAN = re.compile(r"^(?:the )?part(?: of (?:the|this|that) (.+?))? (?:that|which) can (?:be )?([a-z-]+)")
_ACTIONS_OF_MAPS = {
    "inside": ("contain", "store", "fill"), "control": ("press", "activate", "adjust"), "lid": ("open", "close"),
    "spout": ("pour",), "grip": ("grasp", "pull", "hang"), "body": ("wrap-grasp", "push", "wrap"),
}  # fmt: skip


@lru_cache(maxsize=512)
def wanted(phrase: str) -> Wanted:
    """Read a phrase. What is not understood means the whole object."""
    know = knowledge()
    generic = _THAT_CAN.match(phrase.strip().lower())
    if generic:
        return _for_action(generic[2], know.object_named(generic[1]) if generic[1] else None)
    said = words(phrase)
    objects = know.find_objects(said)
    spoken = re.match(r"(?:the |a |an )?(.+?) of (?:the |a |an |this |that |my )?(.+)$", " ".join(said))
    if spoken:
        owner = _PLACE.split(spoken[2])[0]  # of "the drawer below the counter" it is the drawer
        named = know.find_objects(words(owner)) or objects
        thing = know.object_named(owner) or (named[-1].value if named else None)
        said_of_part = [] if thing and thing.part_named(spoken[1]) else words(spoken[1])
        of_part = {f"part_{name}": value for name, value in _qualifiers(said_of_part).items() if name != "size"}
        return replace(_part(spoken[1], thing), **_qualifiers(words(owner), thing), **of_part)
    content = [word for word in said if word not in {"the", "a", "an", "this", "that", "my"}]
    plain = [word for word in content if word not in QUALIFIERS]
    if objects and objects[0].end - objects[0].start == len(plain):
        thing = objects[0].value
        itself = _part(thing.name, thing) if thing.part_named(thing.name) else _whole(thing)
        return replace(itself, **_qualifiers(content, thing))
    if shape := know.shapes.get(stem(plain)):
        return Wanted(shape, part=_PART_MAPS[shape])
    decision = decide(phrase)
    if decision.phrase and decision.phrase != phrase:
        return wanted(decision.phrase)
    shape = next((know.shapes[stem(word)] for word in reversed(said) if stem(word) in know.shapes), "whole")
    return Wanted(shape, part=_PART_MAPS[shape])


def _qualifiers(said: Sequence[str], thing: KnownThing | None = None) -> dict[str, str]:
    """The first colour, side and size in the words before a name."""
    name = set(words(thing.name)) if thing else set[str]()
    found: dict[str, str] = {}
    for word in said:
        if word in QUALIFIERS and word not in name:
            found.setdefault(*QUALIFIERS[word])
    return found


def _whole(thing: KnownThing) -> Wanted:
    return Wanted("whole", object=thing.key, kind=thing.kind)


def _for_action(verb: str, thing: KnownThing | None) -> Wanted:
    """The part of a known thing that affords a verb; else the map that such a part is usually on."""
    actions = knowledge().action_index.get(stem(verb), (verb,))
    for action in actions if thing else ():
        part = thing.part_for(action) if thing else None
        if thing and part:
            return replace(_part(part.name, thing), action=action)
    action = actions[0]
    usual = (name for name, listed in _ACTIONS_OF_MAPS.items() if verb in listed or action in listed)
    part_map = next(usual, "work")
    shape = {"grip": "handle", "inside": "opening", "control": "spot", "lid": "top"}.get(part_map, part_map)
    return Wanted(shape, part=part_map, action=verb)


def _part(name: str, thing: KnownThing | None) -> Wanted:
    """The shape of a part by its name, by the object's own parts first."""
    stems = stem(name)
    whole = _whole(thing) if thing else Wanted("whole")
    for start in range(len(stems)):  # "the left handle" is a handle
        for part in thing.parts if thing else ():
            if part.is_called(stems[start:]):
                return replace(whole, shape=part.shape, part=part.map or _PART_MAPS[part.shape])
        if shape := knowledge().shapes.get(stems[start:]):
            return replace(whole, shape=shape, part=_PART_MAPS[shape])
    return whole
