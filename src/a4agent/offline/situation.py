"""What one sentence and one picture offer to decide on: the things named and seen, and the tools for the job."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from a4agent.offline.knowledge import Knowledge, KnownPart, KnownThing, stem
from a4agent.offline.language import Reading, Verb
from a4agent.offline.noun_phrases import Noun

BY_HAND = frozenset(["activate", "adjust", "close", "fasten", "grasp", "open", "press", "pull", "push", "turn", "hang"])
_HANDLING = frozenset(["grasp", "place", "pull", "push"])
_MOVED = frozenset(["press", "pull", "push", "turn"])


def _in_third_person(verb: Verb) -> bool:
    """Whether a part does it and not a hand: "the part that picks up"."""
    said, base = verb.text.split()[0], verb.base.split()[0]
    return said.endswith("s") and not base.endswith("s")


@dataclass(frozen=True)
class Situation:
    """One sentence as read, the things in the picture, the likeliest first, and the knowledge base."""

    reading: Reading
    seen: tuple[KnownThing, ...]
    know: Knowledge
    unlikely: frozenset[str] = frozenset()

    def shown(self, nouns: Sequence[Noun]) -> list[Noun]:
        """The nouns that name something in the picture."""
        keys = {thing.key for thing in self.seen}
        return [noun for noun in nouns if noun.thing and keys & {noun.thing.key, noun.thing.kind}]

    def _has_tool(self) -> bool:
        """Whether a tool is named that does what the sentence asks: "pry the lid off with a screwdriver"."""
        tools = [noun.thing for noun in self.reading.nouns if noun.role == "tool" and noun.thing]
        done = [action for verb in self.reading.verbs for action in verb.actions if action != "grasp"]
        return any(tool.part_for(action) for tool in tools for action in done)

    def _is_remark(self, noun: Noun) -> bool:
        """Whether the sentence only describes a part: "the body is hot"."""
        after = self.reading.words[noun.end : noun.end + 1]
        return bool(after) and after[0] in {"is", "are", "was", "were", "feels", "looks", "seems"}

    @property
    def _things(self) -> list[KnownThing]:
        return [noun.thing for noun in self.reading.nouns if noun.thing]

    @property
    def _candidates(self) -> list[Noun]:
        """Known things, tools first, then what is acted on, then places."""
        order = {"tool": 0, "object": 1, "aim": 1, "owner": 2, "place": 2, "goal": 3}
        things = (noun for noun in self.reading.nouns if noun.thing)
        return sorted(things, key=lambda n: (order[n.role], self._is_remark(n)))

    @property
    def _states(self) -> bool:
        """Whether the sentence describes instead of asking: "the mug is empty"."""
        return bool({"is", "are", "was", "were", "has"} & set(self.reading.words))

    def _instead(self, verb: Verb) -> tuple[str, ...]:
        return tuple(action for one in verb.actions[:2] for action in self.know.instead.get(one, ()))

    def _part(self, thing: KnownThing, action: str) -> KnownPart | None:
        """The part that affords an action and is not ruled out; for a hand, any part that does not cut."""
        ruled_out = {stem(noun.part) for noun in self.reading.unwanted if noun.part}
        ruled_out_actions = set(self.reading.unwanted_actions) - BY_HAND
        banned = {part.name for part in thing.parts if part.is_called(*ruled_out)}
        banned |= {p.name for p in thing.parts if ruled_out_actions & set(p.affords) and "grasp" not in p.affords}
        able = [p for p in thing.parts if action in p.affords and p.name not in banned]
        purposes = {one for verb in self.reading.verbs if verb.purpose for one in verb.actions}
        serving = [p for p in thing.parts if purposes & set(p.affords) and p.name not in banned]
        moved = [p for p in serving if action in _MOVED and BY_HAND - purposes & set(p.affords)]
        part = next((p for p in serving if p in able), next(iter((*moved, *able)), None))
        if part or action != "grasp" or not thing.part_for("grasp"):
            return part
        left = [p for p in thing.parts if p.name not in banned and not {"cut", "spear"} & set(p.affords)]
        return next((p for p in left if p.name in ("body", "rim", "base", "shaft")), left[0] if left else None)

    @property
    def _own_nouns(self) -> list[Noun]:
        """Nouns that are acted on, without what is only a place or a helper."""
        return [n for n in self.reading.nouns if n.role in ("object", "tool", "aim") and n.definite]

    @property
    def _asks(self) -> bool:
        return bool({"where", "what", "which", "how"} & set(self.reading.words))

    def reached_for(self) -> tuple[KnownThing, str] | None:
        """The tool for what is to be done, and the action: by verb and what it is done to, then by a wish."""
        if tool := self._named_by_verb():
            return tool
        themes = self.know.find_themes(self.reading.words)
        verbs = [verb for verb in self.reading.verbs if set(verb.actions) != {"grasp"}] or list(self.reading.verbs)
        for verb in verbs:
            for theme in themes:
                for action, name in theme.value:
                    if action in verb.actions:
                        return self.know.objects[name], action
        return self.wished()

    def _named_by_verb(self) -> tuple[KnownThing, str] | None:
        """The tool that a verb is named after: "mop the floor", "ladle the soup"."""
        for verb in self.reading.verbs:
            word = verb.text.split()[0]
            usual = self.know.default_index.get(word, (word,))[0]  # one scoops with a spoon
            thing = self.know.objects.get(word) if usual == word else None
            for action in verb.actions if thing else ():
                if thing and action != "grasp" and thing.part_for(action):
                    return thing, action
        return None

    def _vessel(self) -> tuple[KnownThing, str] | None:
        """What a drink is in, when a hand takes it: "hold my coffee"."""
        if self._things or not any(set(verb.actions) & {"grasp", "drink"} for verb in self.reading.verbs[:1]):
            return None
        pairs = (pair for theme in self.know.find_themes(self.reading.words) for pair in theme.value)
        return next(((self.know.objects[name], "grasp") for action, name in pairs if action == "drink"), None)

    def _by_verb_alone(self) -> tuple[KnownThing, str] | None:
        """What is reached for to do such a thing to anything."""
        return next((tool for verb in self.reading.verbs for tool in self._usual_tools(verb)), None)

    def _usual_tools(self, verb: Verb) -> list[tuple[KnownThing, str]]:
        """What is usually taken to do what a verb may mean, and the action."""
        names = ((name, action) for action in verb.actions for name in self.know.default_index.get(action, ()))
        return [(self.know.objects[name], action) for name, action in names]

    def wished(self) -> tuple[KnownThing, str] | None:
        """What helps someone who only says what is wrong: "the soup is cold". A verb still chooses the part."""
        for wish in self.know.wishes:
            if re.search(wish.says, self.reading.text):
                thing = self.know.objects[wish.object]
                asked = (action for verb in self.reading.verbs for action in verb.actions if action in BY_HAND)
                other = (action for action in asked if action not in (wish.action, "grasp"))
                return thing, next((action for action in other if thing.part_for(action)), wish.action)
        return None

    def _part_of_a_usual_tool(self, verb: Verb) -> str | None:
        """The part of the tool that is usually taken for such a job: one stirs with the bowl of a spoon."""
        tools = self._usual_tools(verb)
        return next((part.name for thing, action in tools if (part := thing.part_for(action))), None)

    def _is_idea(self, noun: Noun) -> bool:
        words = noun.text.split()
        return any(stem(words[-count:]) in self.know.untouchable for count in (1, 2, 3))

    @property
    def _done_by_hand(self) -> list[Verb]:
        """The verbs without what a part does itself: "which end goes into the slot?"."""
        return [v for v in self.reading.verbs if not (_in_third_person(v) and _HANDLING & set(v.actions))]

    @property
    def _wanted_actions(self) -> list[str]:
        """The actions of the verbs, without what a part cannot do itself."""
        by_hand = self._done_by_hand
        verbs = self.reading.verbs
        return [action for v in verbs for action in v.actions if v in by_hand or action not in _HANDLING]

    @property
    def _asks_for_a_tool(self) -> bool:
        """Whether a purpose that needs a tool is all there is: "what do I pull to flush?"."""
        aims = {action for verb in self.reading.verbs if verb.purpose for action in verb.actions}
        return not self.reading.nouns and bool(aims & set(self.know.default_index)) and not aims & BY_HAND

    def _spoken(self, action: str) -> str:
        """The speaker's own verb for an action."""
        return next((verb.base for verb in self.reading.verbs if action in verb.actions), action)

    @property
    def _action(self) -> str | None:
        return next(iter(self._wanted_actions), None)

    def _is_handled(self, name: str) -> bool:
        """Whether a part of this name is there for a hand to do what the first verb says: "press the stop button"."""
        done = set(self.reading.verbs[0].actions) & BY_HAND if self.reading.verbs else set[str]()
        return any(
            done & set(part.affords)
            for thing in self.know.objects.values()
            for part in thing.parts
            if part.is_called(stem(name))
        )
