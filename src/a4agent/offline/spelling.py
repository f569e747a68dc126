"""Spelling: words that are not known are replaced by the nearest word of the knowledge base.

    corrected("pikc up teh scisors")   -> "pick up the scissors"
    corrected("grabthe mug")           -> "grab the mug"
    corrected("open the casket")       -> "open the casket": nobody mistypes the first letter of "basket" that way
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import lru_cache

from a4agent.errors import require
from a4agent.offline.knowledge import QUALIFIERS, knowledge, stem

COMMON = frozenset(
    """
a able about above across after again ago ahead air all almost alone along already also always am among an and animal
another any anybody anyone anything anywhere appear are area arm around as ask assistant at away baby back bad bake bar
barn bathroom be bear beat beautiful became because become bed bedroom been before began begin behind being believe
below beside best better between beyond bit bite black blow body bone book boss both bottom boy branch break bright
bring broken brother brown build burn busy but buy by call came can care cat catch caught center centre chance change
cheap check chest child children choose circle class clean clear cloth cloud cold color colour come comes common
compute contact cook corner correct cost could count country course cover cow create cross cry cup dad dance danger
dark daughter day dead dear deep desk did die different dinner direction dirt dirty do doctor does dog doing done
double doubt down dream dress dry due during dust each ear early earth easy eat edge egg eight either else empty end
enough entire even evening ever every everybody everyone everything exact example except eye face fact fall family far
farm fast father favor favour feel feet few field fifth find finger fire first fish five fix flat floor fly folk follow
food foot for force form forward found four fourth free fresh friend from front fruit full fun game garden gave gently
get girl give glad go goat goes going gold gone good got grandma grandpa grass great green grew ground group grow guest
guy had hair half hall hand happen happy hard has hat have he head hear heart heat heavy height hello help her here
hers hi high him his hit hold hole home hope horse hot hour house how however huge human hundred hungry hurry hurt i
ice idea if image important in inch inside instead interact into is it its job join joke jump just keep kept kid kill
kind king kitchen knew know known lady lake land large last late later laugh lay lead leaf learn least leave led left
leg less let letter level lie life light like line lion list listen little live local long look lose lost lot loud love
low luck lunch machine made make man many map mark market matter may maybe me mean meant meat meet men mess message
metal middle might mile milk mind mine minute miss mom moment money month mood moon more morning most mother mountain
mouth move movie much mud music must my name near neck need needs neighbour neighbor never new news next nice night nine
no nobody noise none noon nor north nose not note nothing notice now number object of off often oh ok old on once one
only open or order other our out over own page paint pair paper parent part party pass past pay people pepper perhaps
person phone photo picture piece pig place plain plan plane plant play please point police poor possible pot pretty
print problem public pull purple push put question quick quickly quiet quite rabbit race rain ran reach read ready real
really reason red rest rice rich ride right ring river road robot rock roll roof room rope rose round rule run sad safe
safely said salt same sand saw say scene school sea seat second see seem seen sell send sentence serious set seven
several shadow shall shape sharp she sheep ship shirt shoe shop short should show shut sick side sign silver since sing
sister six size skin sky sleep slow slowly small smell smile smooth snow so soap soft soil sold some somebody someone
something sometimes son song soon sort sound soup south space speak special spell spend spoke spot spread spring square
stairs stand star start state stay step stick still stone stood stop store storm story straight strange street string
strong student stuff such sudden sugar suit summer sun sure surface sweet table tail take talk tall tank task taste tea
teach tell ten test than thank thanks that the their them then there these they thick thin thing things think third this
those though thought three threw through throw tie tight till time tiny tip to today toe together told tomorrow tone too
took tool top total touch toward town toy track train travel tree trip trouble truck true trunk trust try tube turn
twelve twenty two type uncle under until up upon us use used useful usual very village visit visitor voice wait wake
walk wall want warm was wash water wave way we wear weather week weight well went were west wet what whatever wheel when
where whether which while white who whole whom whose why wide wife wild will win wind wine winter wish with within
without woman women won wonder wood word work world would write wrong yard year yellow yes yesterday yet you young your
zero zoo airport bank basketball breakfast capital cheese chicken coat computer cookie cracker curious discussion
dollar email euro france grandmother guitarist hatch hook hotel iron jacket language mail meeting mum nurse office
oil onion poem price pizza restaurant sandwich shower steak station student supper teacher tennis traffic translate
university valley weekend widget bounce crate sleeve passport socks current post peg
""".split()
)
"""Everyday words that are spelt right although knowledge.toml does not need them."""


@lru_cache(maxsize=1)
def _known() -> tuple[frozenset[str], tuple[str, ...]]:
    """Stems of all words that are left alone, and the words that others may be corrected to."""
    know = knowledge()
    phrases = [*know.object_index, *know.part_index, *know.action_index, *know.theme_index]
    stems = {word for phrase in phrases for word in phrase} | {stem(word)[0] for word in COMMON}
    stems |= {word for names in know.untouchable for word in names}
    stems |= {stem(word)[0] for wish in know.wishes for word in re.findall("[a-z]{4,}", wish.says)}
    return frozenset(stems), tuple(sorted(set(know.written) | set(COMMON) | set(QUALIFIERS)))


def corrected(text: str) -> str:
    """The text (lower case) with unknown words replaced by near ones that are known."""
    return re.sub(r"[a-z]+(?:[-'][a-z]+)*", lambda match: _word(match[0]), text)


@lru_cache(maxsize=4096)
def _word(word: str) -> str:
    stems, vocabulary = _known()
    stemmed = stem(word)
    if len(word) < 3 or not stemmed or stemmed[0] in stems or word.endswith("ly"):
        return word
    if "-" in word or "'" in word:
        joined = word.replace("-", "")
        return joined if stem(joined) and stem(joined)[0] in stems else word
    glued = next((end for end in ("the", "this", "that", "my", "it") if word.endswith(end)), None)
    if glued and word.removesuffix(glued) in vocabulary:
        return f"{word.removesuffix(glued)} {glued}"
    return _nearest(word, vocabulary) or word


def _nearest(word: str, vocabulary: Iterable[str]) -> str | None:
    """The nearest known word that a slip of the fingers explains, None if there is none."""
    rapidfuzz = require("rapidfuzz", extra="offline")
    allowed = 1 if len(word) < 7 else 2
    found = rapidfuzz.process.extract(
        word, vocabulary, scorer=rapidfuzz.distance.OSA.distance, score_cutoff=allowed, limit=12
    )
    likely = [(distance, *_unlikelihood(word, other), other) for other, distance, _ in found if _possible(word, other)]
    return min(likely)[-1] if likely else None


_VOWELS = frozenset("aeiouy")


def _possible(word: str, other: str) -> bool:
    """Whether one may be typed for the other: the first letter is rarely wrong, and short words differ by more."""
    if len(other) < 3 or (word[0] != other[0] and sorted(word[:2]) != sorted(other[:2])):
        return False
    if abs(len(word) - len(other)) > 1 and (word.startswith(other) or other.startswith(word)):
        return False  # "decanter" is a word of its own
    if len(word) == 3:
        return len(other) == 4 or sorted(word) == sorted(other)
    return len(word) > 4 or _slip(word, other) < 3


def _slip(word: str, other: str) -> int:
    """How unlikely a slip is: swapped letters, a doubled letter or wrong vowel, a missing, an added, a wrong letter."""
    if sorted(word) == sorted(other):
        return 0
    if len(word) == len(other):
        wrong = {letter for pair in zip(word, other, strict=True) if pair[0] != pair[1] for letter in pair}
        return 1 if wrong <= _VOWELS else 4
    if re.sub(r"(.)\1+", r"\1", word) == re.sub(r"(.)\1+", r"\1", other):
        return 1
    return 2 if len(other) > len(word) else 3


def _unlikelihood(word: str, other: str) -> tuple[int, bool, int]:
    """Smaller for likelier slips, then for words of the knowledge base, then by the length of the common beginning."""
    pairs = enumerate(zip(word, other, strict=False))
    beginning = next((at for at, (a, b) in pairs if a != b), min(len(word), len(other)))
    return _slip(word, other), other not in knowledge().written, -beginning
