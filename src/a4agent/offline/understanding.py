"""From an instruction to the part to act on, by rules over the knowledge base.

    understand("drink from the mug without burning your hand")
        -> Decision(object_name="mug", part_name="handle", because="...")
    understand("which part goes into the screw to tighten it?") -> the shaft of the screwdriver
    understand("translate this letter")                         -> Decision(None, None, because="I do not know ...")

The order of the rules is the order of the evidence: a part that is named, an object that is named, an
object that is reached for to do such a thing, and what things that are not known are usually handled by.
Nothing is looked at: the picture plays no role here.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from a4agent.offline.english import is_english
from a4agent.offline.knowledge import Knowledge, Mention, Part, Thing, knowledge, stem, words
from a4agent.offline.wording import DEFINITE, first_noun, modifiers, noun_from, plain


@dataclass(frozen=True)
class Decision:
    """The object and its part, or None for both; `because` is the reason in words; `action` what will be done."""

    object_name: str | None
    part_name: str | None
    because: str
    action: str = "use"

    @property
    def phrase(self) -> str:
        """ "the handle of the mug", or "" when there is no answer."""
        return f"the {self.part_name} of the {self.object_name}" if self.part_name else ""


_NOT_MEANT = re.compile(
    r"\b(?:without|instead of|rather than|but not|not by|and not|don't|do not|avoid(?:ing)?)\b[^,;.?!]*"
)
_SAFELY = re.compile(r"\b(?:burn|hurt|cut(?:ting)?|injur|scald|prick)\w*\b")
_HOLDING = re.compile(
    r"\b(?:where|which|what|how)\b[^?.!]*\b(?:hold|grip|grasp|grab|touch|pick|take|carry|lift|hand|fingers?)\b"
    r"|\b(?:hand|fingers?|palm|grip|grasp|hold)\b[^?.!]*\b(?:go|goes|belongs?|rests?|wraps?)\b"
)
_BEFORE_QUESTION = re.compile(r"^(.*[.!?;,])(?=\s*(?:so )?(?:where|what|which|how)\b[^.!?;,]*\?*\s*$)", re.DOTALL)
_OF_IT = re.compile(r"by the$|(?:by|with|at|on|from|using|take|hold|grab) (?:one of |both |both of )?(?:its|their)$")
_WHICH_PART = re.compile(r"^(?:which|what) (?:part|end|side|bit|piece|portion) of (?:the|this|that|my|a|an)$")
_ABOUT_FACTS = re.compile(r"\s*(?:who|whose|whom|why|when (?:did|do|does|is|was|were|will))\b")
_BEFORE_VERBS = {"to", "can", "i", "you", "and", "please", "could", "will", "would", "should", "must", "let's", "then"}

_BY_HAND = {"activate", "adjust", "close", "fasten", "grasp", "open", "press", "pull", "push", "turn"}
_DONE_TO_IT = {"climb", "drink", "kick", "lie", "play", "ride", "sit", "throw", "wear"}
"""Actions that a named object undergoes itself: nobody reaches for a ball to kick a door."""

_PARTICLES = (["out"], ["up"], ["down"], ["in"], ["over"])
_CLOSE = {
    "hang": ("grasp",),
    "throw": ("grasp",),
    "kick": ("push", "grasp"),
    "extract": ("pull", "grasp"),
    "fasten": ("turn",),
}


def understand(instruction: str) -> Decision:
    """Decide, or say why not. The same instruction always gets the same answer."""
    if not is_english(instruction):
        return Decision(None, None, "I only know English, and this instruction does not look like it.")
    if _ABOUT_FACTS.match(instruction.lower()):
        return _unknown(instruction)
    know = knowledge()
    text = instruction.lower().replace("’", "'")
    meant = plain(_NOT_MEANT.sub(" ", text), know.action_index)
    aside = " ".join(_NOT_MEANT.findall(text))
    said = words(meant)
    objects = [o for o in know.find_objects(said) if not _is_verb(said, o, know)]
    parts = know.find_parts(said)

    named = _its_part(said, objects, parts) or _named_part(said, objects, parts, know)
    if named:
        return named
    told = _BEFORE_QUESTION.match(meant)
    verbs = _verbs(said, objects, know)
    asked = [verb for verb in verbs if told and verb.start >= len(words(told[1]))]
    first_asked = [*asked, *(verb for verb in verbs if verb not in asked)]
    holding = bool(_HOLDING.search(meant)) or ("without" in aside and bool(_SAFELY.search(aside)))

    if objects:
        return _with_objects(said, objects, asked or verbs, holding, know, instruction)
    tool = _reached_for(said, first_asked, know) or _not_in_the_book(said, first_asked, know)
    if tool is None:
        tool = _by_verb_alone(first_asked, know)
    if isinstance(tool, Decision):
        return tool
    if tool is None:
        return _unknown(instruction)
    thing, action = tool
    part = (thing.part_for("grasp") if holding else None) or thing.part_for(action)
    if part is None:
        return _unknown(instruction)
    because = f"A {thing.name} is what one reaches for to {action}; its {part.name} "
    return Decision(thing.name, part.name, because + ("is where it is held." if holding else "does that."), action)


def _its_part(said: list[str], objects: list[Mention[Thing]], parts: list[Mention[str]]) -> Decision | None:
    """The part in "lift the thermos by its handle", of whatever is named before, known or not."""
    for mention in parts:
        of_it = modifiers(said, mention.start)
        start = mention.start - len(of_it or ())
        following = said[mention.end] if mention.end < len(said) else ""
        if not _OF_IT.search(" ".join(said[:start])) or following in {"is", "are", "was", "were", "of"}:
            continue
        before = [o.value.name for o in objects if o.end < start]
        owner = before[-1] if before else first_noun(said[: start - 1]) or "object"
        part = " ".join(said[start : mention.end])
        return Decision(owner, part, f"The instruction itself names the {part} of the {owner}.")
    return None


def _named_part(
    said: list[str], objects: list[Mention[Thing]], parts: list[Mention[str]], know: Knowledge
) -> Decision | None:
    """ "the handle of the pan", "the pan's handle", "by its handle", "the blade"."""
    for mention in parts:
        at = [o for o in objects if o.start < mention.end and mention.start < o.end]
        belongs = any(
            re.fullmatch("(?:of|off|on|from) (?:the|a|an|this|that|my)", " ".join(said[mention.end : o.start]))
            and o.value.part_named(mention.value)
            for o in objects
        )
        if (at and not belongs) or _WHICH_PART.search(" ".join(said[: mention.end + 2])):
            continue  # "mug" is no part, and the "paper cup" is no cup of something
        if any(o.start == mention.end for o in objects) and not any(o.end == mention.start for o in objects):
            continue  # "the bottom drawer", "the top shelf": which one, not which part
        before = said[max(0, mention.start - 2) : mention.start]
        between = modifiers(said, mention.start)
        after = said[mention.end : mention.end + 2]
        spoken = " ".join(said[mention.start : mention.end])
        if spoken not in know.part_names and mention.value != spoken and stem(spoken) in know.action_index:
            continue  # "slide the window open"
        of = [
            o
            for o in objects
            if o.start >= mention.end and o.start - mention.end <= 3 and "of" in said[mention.end : o.start]
        ]
        on = [o for o in objects if o.start >= mention.end and o.start - mention.end <= 3
              and {"on", "at", "in", "off"} & set(said[mention.end : o.start])]  # fmt: skip
        owner = [o for o in objects if o.end == mention.start]
        marked = between is not None or bool({"the", "its", "by", "their"} & set(before)) or bool(owner)
        if of or on or owner:
            thing = (of or owner or on)[0].value
        elif marked and objects and "to" not in after:
            thing = next((o.value for o in objects if o.value.part_named(mention.value)), None)
            if thing is None or _is_verb(said, mention, know):
                continue
        elif (
            marked
            and not objects
            and not _is_verb(said, mention, know)
            and (_stands_alone(mention.value, know) or _is_handled(mention.value, _verbs(said, objects, know), know))
        ):
            tool = _reached_for(said, _verbs(said, objects, know), know)
            thing = tool[0] if tool and tool[0].part_named(mention.value) else None
            if thing is None and "of" in after:
                continue  # of something this knowledge base has never heard of: still a part of it
            if thing is None:
                spoken = " ".join([*(between or ()), *said[mention.start : mention.end]])
                return Decision("object", spoken, f"The instruction itself names the {spoken}.")
        else:
            continue
        part = thing.part_named(mention.value)
        if part is None and not of and not owner:
            continue
        spoken = " ".join(said[mention.start : mention.end])
        return Decision(thing.name, spoken, f"The instruction itself names the {spoken} of the {thing.name}.")
    unknown = re.search(
        r"\bthe ([a-z]+(?: [a-z]+)?) of (?:the|this|a|my|that) ([a-z-]+(?: [a-z-]+)?)\s*[.?!]*$", " ".join(said)
    )
    if unknown and not objects and stem(unknown[1]) in know.part_index:
        return Decision(unknown[2], unknown[1], f"The instruction itself names the {unknown[1]} of the {unknown[2]}.")
    return None


def _stands_alone(name: str, know: Knowledge) -> bool:
    """Whether a word is first of all the name of a part ("blade"), and not of a workpiece ("nut")."""
    first_names = {part.name for thing in know.objects.values() for part in thing.parts}
    return name in first_names and stem(name) not in know.theme_index


def _is_handled(name: str, verbs: list[Mention[tuple[str, ...]]], know: Knowledge) -> bool:
    """Whether a part of this name is there for a hand to do what the first verb says: "press the stop button"."""
    done = set(verbs[0].value) & _BY_HAND if verbs else set[str]()
    parts = (
        part
        for thing in know.objects.values()
        for part in thing.parts
        if stem(name) in {stem(known) for known in (part.name, *part.also)}
    )
    return any(done & set(part.affords) for part in parts)


def _is_verb(said: list[str], mention: Mention[Any], know: Knowledge) -> bool:
    """Whether words that may name an object or a part are a verb here: "scoop sugar", "to handle", "can press"."""
    written = tuple(said[mention.start : mention.end])
    if written[-1].endswith(("ed", "ing")) and written not in know.object_index and written not in know.part_index:
        return stem(written) in know.action_index  # "the machine is switched over"
    before = said[mention.start - 1] if mention.start else "to"
    last = mention.end == len(said)
    return not last and before in _BEFORE_VERBS and stem(said[mention.start : mention.end]) in know.action_index


def _verbs(said: list[str], objects: list[Mention[Thing]], know: Knowledge) -> list[Mention[tuple[str, ...]]]:
    """The verbs in order, without nouns and those inside an object's name ("measuring cup")."""
    found: list[Mention[tuple[str, ...]]] = []
    for mention in know.find_actions(said):
        if any(o.start <= mention.start < o.end for o in objects) and mention.start > 0:
            continue
        before = said[mention.start - 1] if mention.start else ""
        if said[mention.start] == "not" or before in {"the", "a", "an", "my", "this", "some", "its", "of"}:
            continue
        found.append(mention)
    return found


def _with_objects(
    said: list[str],
    objects: list[Mention[Thing]],
    verbs: list[Mention[tuple[str, ...]]],
    holding: bool,
    know: Knowledge,
    instruction: str,
) -> Decision:
    """One of the named objects, or the tool that is used on it."""
    moved = bool(verbs) and bool({"grasp", "pull", "push"} & set(verbs[0].value))  # away from something, not with it
    signs = {"with", "using", "use", "via"} | (set[str]() if moved else {"from"})
    tools = [o for o in objects if o.start and signs & set(said[max(0, o.start - 3) : o.start])]
    rest = [o for o in objects if o not in tools]
    ordered = [mention.value for mention in tools + rest]
    if holding:
        part = ordered[0].part_for("grasp")
        if part:
            return _because(ordered[0], part, "grasp", f"The {ordered[0].name} is held by its {part.name}.")
    if _WHICH_PART.match(" ".join(said[: objects[0].start])):
        return _asked_about(said, objects[0].value, verbs)
    tool = (_reached_for(said, verbs, know) or _by_verb_alone(verbs, know)) if not tools else None
    for verb in verbs:
        if verb.value == ("grasp",) and verb is not verbs[-1] and _carries_on(said, verb, verbs):
            continue
        if tool and tool[1] in verb.value and tool[1] not in _DONE_TO_IT and not _does(ordered[0], verb.value):
            part = tool[0].part_for(tool[1])
            if part:
                return _because(tool[0], part, tool[1], f"To {tool[1]} that, one takes a {tool[0].name}.")
        for mention in tools + rest:
            thing = mention.value
            for action in verb.value:
                part = thing.part_for(action)
                if part:
                    return _because(thing, part, action, _used_for(said, verb, action, thing, part, mention.start))
    for verb in verbs:
        for action in _instead(said, verb, know):
            for thing in ordered:
                part = thing.part_for(action)
                if part:
                    why = f"For that, one would {action} the {thing.name} at its {part.name}."
                    return _because(thing, part, action, why)
    if not verbs:
        thing = ordered[0]
        if len(said) - (objects[0].end - objects[0].start) <= 2:  # "the mug": nothing to do was said
            part = thing.part_for("grasp") or thing.parts[0]
            return _because(thing, part, "grasp", f"Nothing is asked of the {thing.name} but to be taken.")
    wish = _wished(said, verbs, know)
    part = wish and wish[0].part_for(wish[1])
    if wish and part:
        return _because(wish[0], part, wish[1], f"What would help is a {wish[0].name}.")
    return _not_in_the_book(said, verbs, know) or _unknown(instruction)


def _instead(said: list[str], verb: Mention[tuple[str, ...]], know: Knowledge) -> tuple[str, ...]:
    """What comes close to a verb that no part is there for: "pull out" is to pull, to throw is to grasp first."""
    particle = said[verb.start + 1 : verb.end]
    bare = know.action_index.get(stem(said[verb.start : verb.start + 1]), ()) if particle in _PARTICLES else ()
    return (*(action for action in bare if action in _BY_HAND), *_CLOSE.get(verb.value[0], ()))


def _asked_about(said: list[str], thing: Thing, verbs: list[Mention[tuple[str, ...]]]) -> Decision:
    """The part of a thing that does something: by its verb, else the first part that is not there to be held."""
    for verb, action in ((one, action) for one in verbs for action in one.value):
        part = thing.part_for(action)
        if part:
            return _because(thing, part, action, _used_for(said, verb, action, thing, part))
    part = next((part for part in thing.parts if part.affords and "grasp" not in part.affords), thing.parts[0])
    return _because(thing, part, "use", f"The {thing.name} does its work with its {part.name}.")


def _used_for(
    said: list[str], verb: Mention[tuple[str, ...]], action: str, thing: Thing, part: Part, place: int = 0
) -> str:
    """Why this part, in the speaker's own verb where it stands as in an order; `place` is where the thing was named."""
    words = said[verb.start : verb.end]
    ordered = not verb.start or said[verb.start - 1] in {"to", "i", "you", "we", "and", "please"}
    if not ordered or words[0].endswith(("ing", "ed")):
        return f"To {action}, the {part.name} of the {thing.name} is used."
    if verb.end <= place and set(said[verb.end : place]) <= DEFINITE | {"a", "an"}:
        return f"To {' '.join(words)} the {thing.name}, its {part.name} is used."
    return f"To {' '.join(words)}, the {part.name} of the {thing.name} is used."


def _carries_on(said: list[str], verb: Mention[tuple[str, ...]], verbs: list[Mention[tuple[str, ...]]]) -> bool:
    """Whether "take", "get" or "put" is only the way to what follows: "get the knife and cut bread"."""
    following = [v for v in verbs if v.start >= verb.end]
    return bool(following) and "and" in said[verb.end : following[0].start]


def _does(thing: Thing, actions: tuple[str, ...]) -> bool:
    return any(thing.part_for(action) for action in actions)


def _reached_for(said: list[str], verbs: list[Mention[tuple[str, ...]]], know: Knowledge) -> tuple[Thing, str] | None:
    """The tool for what is to be done, and the action: by verb and theme, then by a wish."""
    themes = know.find_themes(said)
    for verb in verbs:
        for theme in themes:
            for action, name in theme.value:
                if action in verb.value:
                    return know.objects[name], action
    return _wished(said, verbs, know)


def _by_verb_alone(verbs: list[Mention[tuple[str, ...]]], know: Knowledge) -> tuple[Thing, str] | None:
    """What is reached for to do such a thing to anything."""
    for verb in verbs:
        for action in verb.value:
            for name in know.default_index.get(action, ()):
                return know.objects[name], action
    return None


def _not_in_the_book(said: list[str], verbs: list[Mention[tuple[str, ...]]], know: Knowledge) -> Decision | None:
    """ "open the hatch": what a thing that is not known is usually handled by, for such a verb."""
    for verb in verbs:
        part = know.usual_part.get(stem(said[verb.start : verb.end]))
        if part is None:
            continue
        noun = noun_from(said, verb.end)
        if noun and stem(noun) in know.part_index:
            return Decision("object", noun, f"The instruction itself names the {noun}.")
        if noun is None and verb.end < len(said) and said[verb.end] in {"a", "an", "some", "any"}:
            return None  # not a thing in this picture
        asked = re.search(
            r"\b(?:where|what) (?:do|should|would|can|must) (?:i|we|you) \w*$", " ".join(said[: verb.start]) + " "
        )
        noun = noun or first_noun(said[: verb.start]) or ("object" if asked else None)
        if noun is None or any(stem(noun.split()[-count:]) in know.untouchable for count in (1, 2, 3)):
            continue
        verb_said = " ".join(said[verb.start : verb.end])
        because = f"I do not know this {noun}; to {verb_said} a thing, most have a {part}."
        return Decision(noun, part, because, verb_said)
    return None


def _wished(said: list[str], verbs: list[Mention[tuple[str, ...]]], know: Knowledge) -> tuple[Thing, str] | None:
    """What helps someone who only says what is wrong: "the soup is cold". A verb still chooses the part."""
    text = " ".join(said)
    for wish in know.wishes:
        if re.search(wish.says, text):
            thing = know.objects[wish.object]
            asked = (action for verb in verbs for action in verb.value if action != wish.action)
            return thing, next((action for action in asked if thing.part_for(action)), wish.action)
    return None


def _because(thing: Thing, part: Part, action: str, why: str) -> Decision:
    return Decision(thing.name, part.name, why, action)


def _unknown(instruction: str) -> Decision:
    return Decision(None, None, f"I do not know which object and part are meant by {instruction.strip()!r}.")
