"""Prepare a sentence as text: correct its spelling, drop polite phrases, split off clauses.

plain("Could you please pikc up the mug?")                  -> "pick up the mug?"
set_apart("hold the knife, not by the blade")               -> ("hold the knife", "not by the blade")
main_and_purpose("lift the kettle in order to pour tea")    -> ("lift the kettle", "in order to pour tea")
joined_verbs("switch the light on", verbs)                  -> "switch on the light"
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from a4agent.offline.knowledge import COLOURS, QUALIFIERS, knowledge, stem
from a4agent.offline.spelling import corrected
from a4agent.offline.translation import in_english

DEFINITE = frozenset(["the", "this", "that", "these", "those", "my", "your", "our", "his", "her", "their", "its"])

_SHORT_FORMS = (
    (r"\bcan't\b|\bcannot\b|\bcan not\b", "could not"),
    (r"\bwon't\b", "will not"),
    (r"n't\b", " not"),
    (r"\b(do|does|is|are|was|were|ca|wo|would|should|could)nt\b", r"\1 not"),
    (r"\blet's\b", "let us"),
    (r"\b(it|that|there|what|where|who|how|here|which)'s\b", r"\1 is"),
    (r"'re\b", " are"),
    (r"'m\b", " am"),
    (r"'ll\b", " will"),
    (r"'d\b", " would"),
    (r"'ve\b", " have"),
    (r"\b(?:pls|plz|plse)\b", "please"),
    (r"\bu\b", "you"),
    (r"\b(turn|switch|take) of (?=the|my|this|that)", r"\1 off "),
)
_YOU = r"(?:you|we|one|somebody|someone|anyone|anybody)"
_I = r"(?:i|we)"
_ASKED = r"(?: (?:it )?if you(?: could| would)?| for you to| you to| to)"
_POLITE = re.compile(
    "|".join(
        rf"\b(?:{frame})(?!\w)"
        for frame in (
            rf"if {_YOU} (?:do not mind|could|would|please|may|like|can|have (?:time|a moment|a minute))",
            r"for (?:me|us)(?! to)",
            r"(?:could|may|might|can) (?:i|we) (?:trouble|ask|bother) you (?:to|for)",
            rf"{_I} (?:was|were|am|are) (?:just )?wondering (?:if|whether) (?:you|we) (?:could|would|might)",
            rf"{_I} (?:would|should|will)(?: really| very much)? (?:appreciate|love|like|prefer|want){_ASKED}",
            rf"{_I} (?:would|will) be (?:grateful|glad|happy|pleased){_ASKED}",
            rf"{_I} (?:really )?(?:want|need|wish|ask|expect){_ASKED.replace('| to', '')}",
            r"would you (?:mind|be able to|be willing to|be (?:so )?kind enough to|like to)",
            r"(?:would|is) it (?:be )?possible (?:for you )?to",
            r"be so (?:kind|good) (?:as to|and)|so kind as to",
            r"do me (?:a|the) favou?r(?: and|:|,)?",
            r"be a (?:dear|darling|love|sweetheart|star)(?: and)?",
            r"(?:give|lend) (?:me|us) a hand(?: and| with)?",
            r"go ahead and|feel free to|you may(?: now)?|go and",
            rf"(?:could|would|will|shall|must) {_YOU}",
            r"help (?:me|us)(?: to| with)?|let (?:us|me)",
            r"try (?:and|to)|(?:make sure|be sure|remember|do not forget)(?: to| that you)",
            r"it is time to|(?:your|the) (?:task|job|goal) is to",
            r"please|kindly|possibly|maybe|perhaps|thanks|thank you(?: very much| so much)?",
            r"(?:show|tell) me(?= (?:what|where|which|how|the (?:part|end|bit|side|spot))\b)",
            r"point (?:to|at|out)(?= the\b)",
            r"hey|hi|hello|ok|okay|robot|assistant|right now|just|now",
            r"quickly|carefully|gently|slowly|safely|firmly|properly",
            r"(?:in|of|from) (?:the|this) (?:image|picture|photo|photograph|scene)",
            r"in the (?:center|centre|middle)(?= of the (?:image|picture|photo))",
        )
    )
)
_WHICH_WAY = re.compile(
    r"\b((?:turn|twist|rotate|slide|push|move|shift|swing|roll)\b[^.;:!?]*?)"
    r" (?:to|towards?) (?:the|your) (?:left|right)\b"
)
_TWO_COLOURS = re.compile(rf"\b({'|'.join(COLOURS)}) and (?:{'|'.join(COLOURS)})\b")
_GIVEN = re.compile(
    rf"\b(?:could|may|might|can) {_I} have\b"
    rf"|\b{_I} (?:want|need|would like|will have|will take)(?= (?:the|that|this|my) (?!part\b))"
)

_RULED_OUT = re.compile(
    r"\b(without|instead of|rather than|but not|and not|not|never|neither|do not|avoid(?:ing)?|except(?: for)?"
    r"|excluding|other than|anything but|anywhere but|apart from"
    r"|mind (?=the|its|your)|beware of|(?:be )?careful with|watch out for"
    r"|leave (?:\w+ ){1,3}alone|(?:keep|stay|leave)(?: \w+){0,2} (?:off|away from|clear of))\b[^,;:.!?]*"
)
_COMPLAINT = re.compile(r"(?<!you )(?<!which )(?<!that )\b(will|does|did|would|could) not\b")  # "it will not open"
_RULED_IN_AGAIN = re.compile(r"\b(?:and|then|but(?! not)|when|while|as|if|so that|to (?=\w+ ?$))\b.*$")
_PURPOSE = re.compile(
    r"\b(?:so that|so as to|in order to|in order that|so(?= (?:i|you|we|they|he|she|it|the|my)\b)|because|since"
    r"|for(?= [a-z]+ing\b)|(?<!where )(?<!how )(?<!what )to(?= [a-z]))\b[^,;:.!?]*"
)
_NOT_A_PURPOSE = re.compile(
    r"to (?:the|a|an|my|me|this|that|it|its|be|him|her|us|them|your|our|someone|where|left|right)\b"
)


def plain(instruction: str) -> str | None:
    """The instruction in lower-case English, spelt right and without polite phrases; None in an unknown language."""
    english = in_english(_expanded(instruction))
    if english is None:
        return None
    text = corrected(_GIVEN.sub("give me", _modal(english)))
    text = _TWO_COLOURS.sub(r"\1", _modal(text))
    return _tidy(_POLITE.sub(" ", _WHICH_WAY.sub(r"\1", text)))


def _modal(text: str) -> str:
    """ "can" is a tin after an article, an adjective or an order, and "could" everywhere else."""
    said = re.findall(r"[\w'-]+|[^\w\s]", text)

    def modal(at: int) -> bool:
        before = said[at - 1] if at else ""
        after = said[at + 1] if at + 1 < len(said) else "."
        if after in _PERSONS or after in {"be", "not", "also", "only"}:
            return True
        if not after[0].isalpha():
            return False
        if before in {"that", "this"}:
            return (stem(after) in knowledge().action_index) or after in {"help", "touch"}
        describes = before in QUALIFIERS or (before, "can") in knowledge().object_index
        adjective = at > 1 and said[at - 2] in _ARTICLES and stem(before) not in knowledge().nouns
        return not (before in _ARTICLES or describes or adjective)

    at = [index for index, word in enumerate(said) if word == "can"]
    modals = iter([modal(index) for index in at])
    return re.sub(r"(?<![\w'-])can(?![\w'-])", lambda match: "could" if next(modals) else "can", text)


_PERSONS = frozenset(["i", "you", "we", "they", "he", "she", "it", "one", "somebody", "someone", "anyone"])
_ARTICLES = DEFINITE | {"a", "an", "any", "some", "every", "each", "another"}


def _expanded(instruction: str) -> str:
    """Lower case, with contractions written out."""
    text = " ".join(instruction.lower().replace("’", "'").replace("‘", "'").split())
    for short, long in _SHORT_FORMS:
        text = re.sub(short, long, text)
    return text


def _tidy(text: str) -> str:
    """Remove the spaces and punctuation that removed words left behind."""
    text = re.sub(r"\s+([,;:.!?])", r"\1", text)
    text = re.sub(r"([,;:.!?])[,;:\s]*(?=[,;:.!?])", r"", text)
    return re.sub(r"^[\s,;:.!?]+|\s+(?=\s)", "", text).strip()


def set_apart(text: str) -> tuple[str, str]:
    """The text without what it rules out, and the clauses removed."""
    ruled_out: list[str] = []
    text = _COMPLAINT.sub(r"\1", text)

    def take(match: re.Match[str]) -> str:
        span = match[0]
        again = _RULED_IN_AGAIN.search(span, len(match[1]))
        kept = span[again.start() :] if again else ""
        ruled_out.append(span[: len(span) - len(kept)])
        return " " + kept

    rest = _RULED_OUT.sub(take, text)
    return _tidy(re.sub(r", *,? *(?=of\b)", " ", rest)), " ; ".join(ruled_out)


def main_and_purpose(text: str) -> tuple[str, str]:
    """The text without its purpose clauses, and those clauses; a lone purpose becomes the main clause."""
    purposes: list[str] = []

    def take(match: re.Match[str]) -> str:
        if _NOT_A_PURPOSE.match(match[0]):
            return match[0]
        before = text[: match.start()].strip()
        if re.search(
            r"\b(?:need|want|have|like|love|wish|going|about|able|has|used|ought|time|supposed|wants|trying|plan|got|needs)$",
            before,
        ):
            return match[0]
        purposes.append(match[0])
        return " "

    main = _PURPOSE.sub(take, text)
    if not re.search(r"[a-z]", main):
        return " ; ".join(purposes), ""
    return _tidy(main), " ; ".join(purposes)


_ANY_NUMBER = "a|an|all|any|both|each|either|every|one|some|" + "|".join(sorted(DEFINITE))
_SPLIT_VERB = re.compile(
    rf"\b([a-z]+) ((?:{_ANY_NUMBER})(?: [\w'-]+){{1,7}}?|it|them|this|that) "
    r"(on|off|up|down|in|out|open|shut|closed|away|over|back)"
    r"(?=\s*(?:$|[.,;:?!]|\b(?:and|again|against|at|before|behind|beside|by|for|from|in|into|now|on|onto|so|then|to|until|using|with)\b))"
)
_OPENED = {"open": "open", "shut": "close", "closed": "close"}


def joined_verbs(text: str, verbs: Mapping[tuple[str, ...], object]) -> str:
    """The text with verb and particle side by side: "switch the light on" -> "switch on the light".

    What is thrown, pushed or slid open is opened, and what is pulled shut is closed. "Back" is dropped, so that it is
    not read as the back of a chair.
    """

    def joined(match: re.Match[str]) -> str:
        verb, noun, particle = match.groups()
        if particle == "back":
            return f"{verb} {noun}" if stem(verb) in verbs else match[0]
        if stem(f"{verb} {particle}") in verbs:
            return f"{verb} {particle} {noun}"
        if particle in _OPENED and stem(verb) in verbs:
            return f"{_OPENED[particle]} {noun}"
        return match[0]

    return _SPLIT_VERB.sub(joined, text)
