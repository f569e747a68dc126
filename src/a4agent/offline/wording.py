"""A decision and the English that explains it: sentences that agree with "mug" and with "scissors"."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from a4agent.offline.knowledge import KnownPart, KnownThing
from a4agent.offline.language import Verb
from a4agent.offline.noun_phrases import Noun

EXAMPLES = "Try 'open the drawer' or 'pick up the mug'."


@dataclass(frozen=True)
class Decision:
    """The thing and its part, or None for both if the sentence is refused.

    `because` is the reason in words, or the refusal; `action` what will be done; `sure` is False for a guess about
    a thing that the knowledge base does not hold.
    """

    object_name: str | None
    part_name: str | None
    because: str
    action: str = "use"
    sure: bool = True

    @property
    def phrase(self) -> str:
        """ "the handle of the mug", "the part that can cut", or "" for a refusal."""
        if not self.part_name:
            return ""
        if self.part_name.startswith("part that can "):
            of_it = "" if self.object_name == "object" else f" of the {self.object_name}"
            return f"the part{of_it} {self.part_name.removeprefix('part ')}"
        if self.object_name and self.part_name == self.object_name.rsplit(" ", maxsplit=1)[-1]:  # a knob
            return f"the {self.object_name}"
        return f"the {self.part_name} of the {self.object_name}"


def noun_of(thing: KnownThing) -> Noun:
    return Noun(thing.name, 0, 0, thing=thing)


def decision(noun: Noun, part: KnownPart, action: str, why: str) -> Decision:
    return Decision(noun.name, part.name, why, action)


def held(noun: Noun, part: KnownPart) -> Decision:
    return decision(noun, part, "grasp", f"Hold the {noun.name} by {its(noun)} {part.name}.")


def used_for(verb: Verb, noun: Noun, part: KnownPart) -> str:
    """Why this part, in the speaker's own verb."""
    if noun.role == "object" and noun.start == verb.end:
        return f"To {verb.base} the {noun.name}, use {its(noun)} {part.name}."
    return f"To {verb.base}, use the {part.name} of the {noun.name}."


def its(noun: Noun) -> str:
    return "their" if _is_plural(noun.text) else "its"


def _is_plural(name: str) -> bool:
    return name.endswith("s") and not name.endswith(("ss", "us"))


def with_article(name: str) -> str:
    """A name with its article: "an iron", "a pair of scissors", "headphones"."""
    if _is_plural(name):
        return f"a pair of {name}" if name in _PAIRS else name
    return f"{'an' if name[0] in 'aeiou' else 'a'} {name}"


_PAIRS = frozenset(
    ["scissors", "pliers", "shears", "tweezers", "tongs", "chopsticks", "glasses", "headphones", "binoculars"]
)


def listed(names: Sequence[str]) -> str:
    named = [with_article(name) for name in dict.fromkeys(names)][:3]
    return named[0] if len(named) == 1 else f"{', '.join(named[:-1])} and {named[-1]}"


def refused(instruction: str, why: str = "") -> Decision:
    shown = " ".join(instruction.split())
    shown = shown if len(shown) <= 80 else shown[:77] + "..."
    reason = why or f"I do not know which part of which thing is meant by {shown!r}."
    return Decision(None, None, f"{reason} {EXAMPLES}")
