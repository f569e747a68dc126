"""Two things are named and the picture lacks one: a tool, or what is to be put somewhere.

wipe the table with the sponge     a table is seen, no sponge   -> the top of the table
put the vase into the drawer       a drawer is seen, no vase    -> the inside of the drawer
"""

from __future__ import annotations

from a4agent.offline.noun_phrases import Noun
from a4agent.offline.situation import Situation
from a4agent.offline.wording import Decision, decision, noun_of

_DESTINED = frozenset(["belong", "go"])
"""Verbs of things that are put somewhere: "the spoons belong in the drawer"."""


class Absence(Situation):
    """The rules for such sentences."""

    def worked_on(self) -> Decision | None:
        """What a tool is used on, where the picture shows that and no such tool: "wipe the table with the sponge"."""
        verb = next((verb for verb in self.reading.verbs if not verb.purpose), None)
        nouns = [noun for noun in self.reading.nouns if verb and noun.start >= verb.end]
        nouns = [noun for noun in nouns if noun.thing and noun.definite and not noun.owner]
        held = self.shown([noun for noun in nouns if noun.role in ("place", "goal")])  # "crack the egg into the bowl"
        noun = next((noun for noun in (*nouns, *held) if noun.role == "object" or noun in held), None)
        thing = noun.thing if noun else None
        if verb is None or noun is None or thing is None:
            return None
        named = [noun.thing for noun in self.reading.nouns if noun.role == "tool" and noun.thing]
        usual = self.reached_for() or self._by_verb_alone()
        tools = named or ([usual[0]] if usual else [])
        if not tools or thing.key in {tool.key for tool in tools} or self.shown([noun_of(tool) for tool in tools]):
            return None
        near = (*(["open"] if "open" in verb.text.split() else []), *verb.actions, *self._instead(verb))
        part = next((part for action in near if (part := self._part(thing, action))), None)
        alone = not named and not part and tools[0].kind in self.unlikely and thing.kind not in self.unlikely
        if not self.shown([noun]) and not alone:
            return None
        wide = (part for part in thing.parts if part.shape in ("whole", "body", "opening"))
        part = part or next(wide, thing.parts[0])
        return decision(noun, part, verb.actions[0], f"I see no {tools[0].key}, so this is about the {noun.name}.")

    def placed(self) -> list[Noun] | None:
        """What is put somewhere, None if nothing is or if the picture shows it: then it is taken hold of."""
        verb = next((verb for verb in self.reading.verbs if "place" in verb.actions and not verb.purpose), None)
        nouns = [noun for noun in self.reading.nouns if noun.role == "object" and not noun.pronoun]
        if verb is None or any(noun.generic for noun in nouns):  # "which end goes into the screw?"
            return None
        return nouns if verb.base in _DESTINED or not self.shown(nouns) else None

    def place(self) -> Decision | None:
        """Where something goes that the picture does not show: "put the vase on the table"."""
        placed = self.placed()
        place = next((n for n in self.reading.nouns if n.role == "goal" and n.thing and not n.owner), None)
        if not placed or place is None or place.thing is None:
            return None
        destined = any(verb.base in _DESTINED for verb in self.reading.verbs)
        if not self.shown([place]) and not destined and any(noun.thing for noun in placed):
            return None
        parts = (self._part(place.thing, action) for action in self.know.instead["place"])
        part = next((part for part in parts if part), None)
        if part is None:
            return None
        return decision(place, part, "contain", f"The {placed[0].name} goes to the {part.name} of the {place.name}.")
