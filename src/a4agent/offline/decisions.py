"""From what a sentence means and what is in the picture to the part to act on.

    decide("drink from the mug without burning your hand")   -> the handle of the mug
    decide("tighten a screw")                                -> the shaft of the screwdriver
    decide("drink from this", seen=("mug",))                 -> the handle of the mug
    decide("find the part that can cut")                     -> the part that can cut
    decide("translate this letter")                          -> a refusal

The order of the rules is the order of the evidence: a part that is named, a thing that is named, a thing in the
picture, a tool for the job, what things of an unknown kind usually have.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

from a4agent.offline.absence import Absence
from a4agent.offline.context import about
from a4agent.offline.knowledge import QUALIFIERS, Knowledge, KnownPart, KnownThing, knowledge, stem
from a4agent.offline.language import Reading, Verb, read
from a4agent.offline.noun_phrases import Noun
from a4agent.offline.situation import BY_HAND
from a4agent.offline.wording import Decision, decision, held, listed, noun_of, refused, used_for, with_article

_FACTS = re.compile(
    r"(?:who|whose|whom|why|when (?:did|do|does|is|was|were|will)|what (?:time|day|year|is the (?!handle|part)))\b"
)
_SHUT = frozenset(["stuck", "jammed", "sealed", "closed", "shut"])
_PART_FOR = re.compile(r"\bparts? (?:.* )?(?:could|for|used|suitable|meant)\b")
DOES = {"turn": ("fasten",)}
"""What a part that can do something does to other things: the tip of a screwdriver turns screws."""
_UNDERGONE = frozenset(["climb", "drink", "kick", "lie", "play", "ride", "sit", "throw", "wear", "contain"])
"""Actions that a named thing undergoes itself: nobody reaches for a ball to kick a door."""


@lru_cache(maxsize=512)
def decide(
    instruction: str,
    seen: tuple[str, ...] = (),
    missing: frozenset[str] = frozenset(),
    unlikely: frozenset[str] = frozenset(),
) -> Decision:
    """Decide, or say why not. The same instruction and things seen always get the same answer.

    Args:
        instruction: what somebody typed.
        seen: kinds of things in the picture, the likeliest first; names of knowledge.toml.
        missing: kinds that the network knows and did not find.
        unlikely: kinds that it hardly found, `missing` included.
    """
    reading = read(instruction)
    if reading is None:
        return refused(instruction, "I can read English, and simple German, French, Spanish, Italian and Dutch.")
    know = knowledge()
    named = any(noun.thing or noun.generic or stem(noun.part or "") in know.part_index for noun in reading.nouns)
    if _FACTS.match(reading.text) and not (named and reading.text.startswith("what")):
        return refused(instruction)
    things = tuple(replace(thing, name=name) for name in seen if (thing := know.object_named(name)))
    found = about(_Decider(reading, things, know, missing | unlikely)).decide() or refused(instruction)
    return _compared(_with_its_looks(found, reading), things, missing, know)


def _with_its_looks(found: Decision, reading: Reading) -> Decision:
    """The part with the qualifiers it is described by: "grab the knife with the black handle"."""
    described = (n for n in reading.nouns if n.part and n.role == "tool" and n.qualifiers and not n.owner)
    noun = next((n for n in described if found.part_name and stem(n.text) == stem(found.part_name)), None)
    return replace(found, part_name=f"{' '.join(noun.qualifiers)} {found.part_name}") if noun else found


def _compared(found: Decision, seen: tuple[KnownThing, ...], missing: frozenset[str], know: Knowledge) -> Decision:
    """The decision, with a note if the picture does not show the named thing."""
    thing = know.object_named(_without_qualifiers(found.object_name or ""))
    if thing is None or thing.kind not in missing:
        return found
    shown = f"shows {listed([other.key for other in seen])}" if seen else "does not show it clearly"
    because = f"{found.because} I see no {thing.key}: the picture {shown}."
    return replace(found, because=because, sure=False)


def _without_qualifiers(name: str) -> str:
    return " ".join(word for word in name.split() if word not in QUALIFIERS) or name


class _Decider(Absence):
    """The rules."""

    def decide(self) -> Decision | None:
        rules = (
            self.worked_on,
            self._named_part,
            self.place,
            self._asked_part,
            self._held,
            self._known_thing,
            self._pronoun,
            self._tool,
            self._guess,
            self._any_part,
            self._working_end,
        )
        return next((found for rule in rules if (found := rule())), None)

    # ---- a part that is named

    def _named_part(self) -> Decision | None:
        nouns = self.reading.nouns
        for place, noun in enumerate(nouns):
            if noun.part is None or (noun.thing and noun.owner is None):
                continue
            owner = noun.owner
            if noun.role == "object" and self._has_tool():
                continue
            if stem(noun.part) not in self.know.part_index and not (owner and self._is_moved(noun, owner)):
                continue
            beside = any(n.role == "object" and n.thing for n in nouns[:place])
            if noun.role in ("place", "goal") and beside and owner and self.placed() is None:
                continue
            if owner is None:
                if self._is_remark(noun) or (noun.role == "tool" and self._things):
                    continue
                meant = self._part_is_meant(noun, nouns[:place])
                owner = self._owner_of(noun, nouns[:place], nouns[place + 1 :]) if meant else None
            if owner is None:
                continue
            if handle := self._handle_instead(noun, owner):
                why = f"To move the {noun.text}, use the {handle.name} of the {owner.name}."
                return decision(owner, handle, "open", why)
            why = f"The instruction itself names the {noun.name} of the {owner.name}."
            return Decision(owner.name, noun.name, why, self._action or "use")
        return None

    def _is_moved(self, noun: Noun, owner: Noun) -> bool:
        """Whether a hand can do what is asked to a part of a name that nobody knows: "pull the frill of the zorble"."""
        by_hand = bool(set(self._wanted_actions) & BY_HAND)
        return by_hand and not self._is_idea(noun) and not self._is_idea(owner)

    def _handle_instead(self, noun: Noun, owner: Noun) -> KnownPart | None:
        """What moves a named part that a hand does not take itself: "open the door of the fridge"."""
        part = owner.thing.part_named(noun.part or "") if owner.thing else None
        opens = next((action for action in self._wanted_actions if action in ("open", "close")), None)
        if part is None or opens is None or owner.thing is None or opens in part.affords:
            return None
        return owner.thing.part_for(opens)

    def _part_is_meant(self, noun: Noun, before: Sequence[Noun]) -> bool:
        """Whether a part without an owner is what to act on: "by its handle", "open the lid", "the blade"."""
        if noun.role == "aim":
            return True
        if noun.role in ("place", "goal"):
            unknown = noun.role == "place"
            return self.reading.placing or any(
                n.thing.part_named(noun.part or "") if n.thing else unknown for n in before if not n.part
            )
        if not noun.definite:
            return False
        stands_alone = stem(noun.part or "") not in self.know.theme_index and noun.part in self.know.first_part_names
        return (
            stands_alone
            or self._is_handled(noun.part or "")
            or any(t.part_named(noun.part or "") for t in self._things)
        )

    def _owner_of(self, part: Noun, before: Sequence[Noun], after: Sequence[Noun]) -> Noun | None:
        """Whose part it is: a thing that is named before or after, one in the picture, a tool, or "the object"."""
        candidates = [
            n
            for n in (*reversed(before), *after, *self.reading.unwanted)
            if (n.part is None or n.thing) and not n.generic and n.owner is None
        ]
        for noun in candidates:
            if noun.thing and noun.thing.part_named(part.part or ""):
                return noun
        if part.role in ("place", "goal") and (
            shown := next((t for t in self.seen if t.part_named(part.part or "")), None)
        ):
            return noun_of(shown)
        unknown = next(
            (n for n in candidates if n.thing is None and not n.pronoun and n.definite and n.role == "object"), None
        )
        if part.role in ("aim", "place", "goal") and unknown:
            return unknown
        if part.role == "aim" and candidates and candidates[0].thing:
            return candidates[0]
        tool = self.reached_for()
        for thing in (*self.seen, *((tool[0],) if tool else ())):
            if thing.part_named(part.part or ""):
                return noun_of(thing)
        return Noun("object", 0, 0, pronoun=True)

    # ---- "which part of the knife cuts?"

    def _asked_part(self) -> Decision | None:
        asked = next((noun for noun in self.reading.nouns if noun.generic), None)
        wanted = self._wanted_actions
        if asked is None:
            return None
        owner = asked.owner
        described = [word for word in asked.text.split() if word.endswith("ing")]  # "the cutting part"
        sense = [action for word in self.reading.words for action in self._sense(word)]
        sense += [action for word in described for action in self.know.action_index.get(stem(word), ())]
        if owner is None or owner.thing is None:
            if owner and not owner.pronoun and owner.part is None:
                return self._guess() or self._working_end()
            return self._of_anything(sense[0], sense[0]) if sense else None
        thing = owner.thing
        if self.reading.holding and (part := self._part(thing, "grasp")):
            return held(owner, part)
        if sense and (part := self._part(thing, sense[0])):
            return decision(owner, part, sense[0], f"That is the {part.name} of the {owner.name}.")
        if "pour" in wanted and thing.part_for("emit"):
            wanted = ["emit", *wanted]
        for action in wanted:
            rim = thing.part_named("rim") if action == "drink" else None
            if part := rim or self._part(thing, action):
                why = f"To {self._spoken(action)}, use the {part.name} of the {owner.name}."
                return decision(owner, part, action, why)
        for action in (other for one in wanted for other in self.know.instead.get(one, ())):
            if part := self._part(thing, action):
                return decision(owner, part, action, f"For that, use the {part.name} of the {owner.name}.")
        part = thing.working_part
        return decision(owner, part, "use", f"That is the {part.name} of the {owner.name}.")

    def _sense(self, word: str) -> Sequence[str]:
        """What an adjective wants of a part: the sharp one cuts, the graspable one is grasped."""
        verb = stem(word.removesuffix("able")) if word.endswith("able") and len(word) > 6 else ()
        return self.know.senses.get(word, ()) or (self.know.action_index.get(verb, ()) if verb else ())

    # ---- "where do I hold it?"

    def _held(self) -> Decision | None:
        if not self.reading.holding:
            return None
        tool = self.reached_for()
        noun = next((n for n in self._candidates if n.thing and (n.definite or not tool)), None)
        if noun and noun.thing and (part := self._part(noun.thing, "grasp")):
            return held(noun, part)
        if not tool and any(n.definite and not n.pronoun for n in self._own_nouns if not n.part and not n.generic):
            return self._guess()
        if tool and (part := self._part(tool[0], "grasp")):
            return held(noun_of(tool[0]), part)
        return self._of_anything("grasp", "hold it")

    # ---- a thing that is named

    def _acted_on(self, nouns: Sequence[Noun], verb: Verb) -> Decision | None:
        """The first of some things that a verb can be done to or with, else that comes close to it."""
        for noun in nouns:
            for action in _actions_on(noun, verb):
                if noun.thing and (part := self._part(noun.thing, action)):
                    return decision(noun, part, action, used_for(verb, noun, part))
        for action in self._instead(verb):
            for noun in nouns:
                if noun.thing and (part := self._part(noun.thing, action)):
                    return decision(noun, part, action, f"For that, use the {part.name} of the {noun.name}.")
        return None

    def _known_thing(self) -> Decision | None:
        candidates = self._candidates
        if any(n.pronoun and n.role == "object" for n in self.reading.nouns):  # "hang it on a hook"
            candidates = [noun for noun in candidates if noun.role not in ("place", "goal")]
        if not candidates:
            return None
        verbs = list(self.reading.verbs)
        tool = None if candidates[0].role == "tool" else (self.reached_for() or self._by_verb_alone())
        for verb in verbs:
            first = candidates[0].thing
            if tool and tool[1] in verb.actions and tool[1] not in _UNDERGONE and first and not _affords(first, verb):
                part = self._part(*tool)
                return part and decision(noun_of(tool[0]), part, tool[1], self._tool_for(tool[1], tool[0], part))
            near = [noun for noun in candidates if noun.role not in ("place", "goal", "owner")]
            for nouns in (near, [noun for noun in candidates if noun not in near]):
                if found := self._acted_on(nouns, verb):
                    return found
        wish = self.wished()
        if wish and (part := self._part(*wish)):
            why = f"{with_article(wish[0].name).capitalize()} would help: use the {part.name}."
            return decision(noun_of(wish[0]), part, wish[1], why)
        noun = candidates[0]
        if noun.role == "tool" and noun.thing and verbs:  # nobody sweeps with a rake, but it would be with its head
            part = noun.thing.working_part
            return decision(noun, part, verbs[0].actions[0], used_for(verbs[0], noun, part))
        if not verbs and noun.thing and _SHUT & set(self.reading.words) and (part := self._part(noun.thing, "open")):
            return decision(noun, part, "open", f"To open the {noun.name}, use the {part.name}.")
        if not verbs and noun.thing and len(candidates) == 1 and not self._states:
            part = self._part(noun.thing, "grasp") or noun.thing.parts[0]
            return decision(noun, part, "grasp", f"Only the {noun.name} is named: hold the {part.name}.")
        return None

    # ---- "drink from this"

    def _pronoun(self) -> Decision | None:
        """What is done to whatever is in the picture."""
        emits = any("emit" in verb.actions for verb in self.reading.verbs)
        unknown = not emits and any(
            n.thing is None and n.part is None and not n.pronoun and not n.generic for n in self._own_nouns
        )
        goal = next((n for n in self.reading.nouns if n.pronoun and n.role == "goal"), None)
        if unknown or any(n.thing and n.role not in ("place", "goal") for n in self.reading.nouns):
            return None
        actions = {action for verb in self.reading.verbs for action in verb.actions}
        fits = any(thing.part_for(action) for thing in self.seen for action in actions)
        if not fits and (self.reached_for() or (self._asks_for_a_tool and not self.seen)):
            return None
        verbs = self._done_by_hand
        nouns, words = self.reading.nouns, self.reading.words
        bare = not nouns and len(words) == 1 and bool(verbs) and verbs[0].actions[0] in BY_HAND
        points = any(n.pronoun or n.generic for n in nouns) or (not nouns and self._asks)
        if not (bare or emits or points):
            return None
        for verb in verbs:
            actions = _actions_on(goal, verb) if goal else verb.actions
            if found := self._of_anything(actions[0], verb.base if actions == verb.actions else actions[0], actions):
                return found
        return None

    def _of_anything(self, action: str, spoken: str, actions: Sequence[str] = ()) -> Decision | None:
        """The part of something in the picture that affords an action, or what most things have for it."""
        noun = next((n for n in self.reading.nouns if n.pronoun), Noun("object", 0, 0, pronoun=True))
        if self.reading.placing and noun.qualifiers:  # "low down"
            board = f"{noun.qualifiers[0]} shelf"
            return Decision(
                self.seen[0].name if self.seen else "object", board, "That is a place on a shelf.", sure=False
            )
        of_its_own = DOES.get(action, ()) if _PART_FOR.search(self.reading.text) else ()
        for thing in self.seen:
            for one in (*of_its_own, *(actions or (action,)), *self.know.instead.get(action, ())):
                if part := self._part(thing, one):
                    why = f"I see {with_article(thing.name)}: to {self._spoken(one)}, use the {part.name}."
                    return decision(noun_of(thing), part, one, why)
        usual = self.know.usual_part.get(stem(spoken)) or self.know.usual_part.get(stem(action))
        name = " ".join((*noun.qualifiers, "object"))
        if usual and not _PART_FOR.search(self.reading.text):
            why = f"No thing is named; most things have {with_article(usual)} to {spoken}."
            return Decision(name, usual, why, action, sure=False)
        part = f"part that can {action}"
        return Decision(name, part, f"No thing is named, so the {part} is looked for.", action)

    # ---- a tool for the job

    def _tool(self) -> Decision | None:
        if any(n.role == "tool" and n.definite and not n.thing and not n.pronoun for n in self.reading.nouns):
            return None
        tool = self._vessel() or self.reached_for()
        if tool is None:
            if self._guess():
                return None
            tool = self._by_verb_alone()
        part = tool and self._part(*tool)
        if not tool or not part:
            return None
        return decision(noun_of(tool[0]), part, tool[1], self._tool_for(tool[1], tool[0], part))

    def _tool_for(self, action: str, thing: KnownThing, part: KnownPart) -> str:
        return f"To {self._spoken(action)}, use the {part.name} of {with_article(thing.name)}."

    # ---- a thing that nobody knows

    def _guess(self) -> Decision | None:
        """ "open the hatch": what a thing of an unknown kind is usually handled by, for such a verb."""
        verbs = self._done_by_hand
        nouns = [noun for noun in self.reading.nouns if noun.thing is None and (not noun.part or noun.role == "tool")]
        for verb in verbs:
            usual = self.know.usual_part.get(stem(verb.text)) or self.know.usual_part.get((verb.actions[0],))
            usual = usual or self._part_of_a_usual_tool(verb)
            by_hand = bool(set(verb.actions) & BY_HAND) or verb.actions[0] in _UNDERGONE or verb.text == "pour"
            for noun in sorted(nouns, key=lambda n: (n.role != "tool", n.role in ("place", "goal"))):
                noun = noun.owner if noun.generic and noun.owner else noun
                if noun.pronoun or noun.generic or self._is_idea(noun) or not (noun.definite or self._asks):
                    continue
                if usual is None or not (by_hand or noun.role == "tool"):
                    continue
                why = f"I do not know this {noun.text}; most things have {with_article(usual)} to {verb.base}."
                return Decision(noun.name, usual, why, verb.text, sure=False)
        return None

    def _any_part(self) -> Decision | None:
        """Any part at all that a hand is to move: "turn the steering wheel"."""
        noun = next((n for n in self.reading.nouns if n.part and n.definite and n.role == "object"), None)
        if noun is None or not (self.reading.verbs and set(self.reading.verbs[0].actions) & BY_HAND):
            return None
        return Decision("object", noun.name, f"The instruction itself names the {noun.name}.", self._action or "use")

    def _working_end(self) -> Decision | None:
        """The end that does the job, where nothing is known about the job: "which end goes down?"."""
        asked = next((noun for noun in self.reading.nouns if noun.generic), None)
        if asked is None and self.seen and self._asks and self.reading.verbs and not self._done_by_hand:
            asked = Noun("object", 0, 0, pronoun=True)  # "what goes into it?"
        if asked is None or (asked.owner and self._is_idea(asked.owner)):
            return None
        if self.seen and (asked.owner is None or asked.owner.pronoun):
            part = self.seen[0].working_part
            return decision(noun_of(self.seen[0]), part, "use", f"I see {with_article(self.seen[0].name)}.")
        owner = asked.owner or Noun("object", 0, 0, pronoun=True)
        why = f"I do not know this {owner.text}, so its working end is looked for."
        return Decision(owner.name, "working end", why, sure=False)


def _actions_on(noun: Noun, verb: Verb) -> tuple[str, ...]:
    """What a verb does to a thing: what is poured or put into it, it contains."""
    if noun.role == "tool" and "grasp" in verb.actions:
        return ("clamp", "spear", "scoop", *(action for action in verb.actions if action != "grasp"), "grasp")
    if noun.role == "goal" and {"pour", "grasp", "contain", "throw"} & set(verb.actions):
        return ("contain", *verb.actions)
    return verb.actions


def _affords(thing: KnownThing, verb: Verb) -> bool:
    return any(thing.part_for(action) for action in verb.actions)
