"""What a phrase asks the detector for: which kind of region, in which kind of object.

wanted("the handle of the screwdriver") -> Wanted(shape="grip", layout=Layout(0.5, 0.45, steel=True))
wanted("the mug")                       -> Wanted(shape="whole", ...)
wanted("the frobnicator's handle")      -> Wanted(shape="handle", ...): a handle, whatever it is of
wanted("cut the bread")                 -> the blade of a knife, as the reasoner would say
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache

from a4agent.offline.knowledge import Thing, knowledge, stem, words
from a4agent.offline.profile import Layout
from a4agent.offline.understanding import understand

DEFAULT = Layout()


@dataclass(frozen=True)
class Wanted:
    """`shape` is one of SHAPES; `layout` counts for those along the object's axis."""

    shape: str
    layout: Layout = DEFAULT


SHAPES = (
    "whole", "grip", "work", "tip", "loop", "arm", "spout", "body", "opening", "rim",
    "top", "middle", "lower", "bottom", "bar", "spot", "handle",
)  # fmt: skip

_ALONG = ("grip", "work", "tip")

# Parts of objects that the knowledge base does not hold.
_BY_NAME = {
    "handle": "handle", "grip": "handle", "hilt": "handle", "knob": "spot", "button": "spot", "switch": "spot",
    "dial": "spot", "trigger": "spot", "latch": "spot", "lock": "spot", "keyhole": "spot", "lid": "top", "cap": "top",
    "cover": "top", "top": "top", "cork": "top", "base": "bottom", "bottom": "bottom", "foot": "bottom",
    "feet": "bottom", "leg": "bottom", "rim": "rim", "lip": "rim", "edge": "rim", "spout": "spout", "nozzle": "tip",
    "beak": "spout", "tip": "tip", "point": "tip", "end": "tip", "nib": "tip", "blade": "work", "head": "work",
    "shaft": "grip", "bristle": "work", "tine": "work", "prong": "work", "jaw": "work", "teeth": "work",
    "bit": "work", "body": "body", "inside": "opening", "interior": "opening", "bowl": "work", "opening": "opening",
    "mouth": "opening",
    "neck": "work", "stem": "middle", "loop": "loop", "strap": "loop", "ring": "loop", "ear": "loop",
}  # fmt: skip
_STEMMED = {stem(name): shape for name, shape in _BY_NAME.items()}
_PLACE = re.compile(
    r" (?:below|under|underneath|beneath|above|over|on|onto|in|inside|at|by|near|next|beside|behind|between|against"
    r"|from|to|that|which|with) "
)


@lru_cache(maxsize=512)
def wanted(phrase: str) -> Wanted:
    """Read a phrase. What is not understood means the whole object."""
    know = knowledge()
    said = words(phrase)
    objects = know.find_objects(said)
    spoken = re.match(r"(?:the |a |an )?(.+?) of (?:the |a |an |this |that |my )?(.+)$", " ".join(said))
    if spoken:
        owner = _PLACE.split(spoken[2])[0]  # of "the drawer below the counter" it is the drawer
        named = know.find_objects(words(owner)) or objects
        thing = know.object_named(owner) or (named[-1].value if named else None)
        return _part(spoken[1], thing)
    content = [word for word in said if word not in {"the", "a", "an", "this", "that", "my"}]
    if objects and objects[0].end - objects[0].start == len(content):
        return Wanted("whole", objects[0].value.layout)
    if stem(content) in _STEMMED:
        return Wanted(_STEMMED[stem(content)])
    decision = understand(phrase)
    if decision.part_name and decision.object_name:
        return _part(decision.part_name, know.object_named(decision.object_name))
    named = next((_STEMMED[stem(word)] for word in reversed(said) if stem(word) in _STEMMED), None)
    return Wanted(named) if named else Wanted("whole")


def _part(name: str, thing: Thing | None) -> Wanted:
    """The shape of a part by its name, by the object's own parts first."""
    stems = stem(name)
    layout = thing.layout if thing else DEFAULT
    for start in range(len(stems)):  # "the left handle" is a handle
        for part in thing.parts if thing else ():
            if stems[start:] in {stem(known) for known in (part.name, *part.also)}:
                return Wanted(part.shape, layout)
        if stems[start:] in _STEMMED:
            return Wanted(_STEMMED[stems[start:]], layout)
    return Wanted("whole", layout)


@lru_cache(maxsize=1)
def everything() -> tuple[Wanted, ...]:
    """Every Wanted that leads to a region of its own."""
    layouts = dict.fromkeys([Layout(), *(thing.layout for thing in knowledge().objects.values())])
    along = [Wanted(shape, layout) for shape in _ALONG for layout in layouts]
    return (*along, *(Wanted(shape) for shape in SHAPES if shape not in _ALONG))
