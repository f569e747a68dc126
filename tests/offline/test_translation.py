"""Word by word into English, from five languages."""

from __future__ import annotations

import pytest

from a4agent.offline.translation import in_english


@pytest.mark.parametrize(
    ("text", "english"),
    [
        ("nimm die rote tasse", "take the red cup"),
        ("mach bitte die tür auf", "open the door"),
        ("prends le marteau, s'il te plaît", "take the hammer , please"),
        ("corta el pan con el cuchillo", "cut the bread with the knife"),
        ("apri il cassetto", "open the drawer"),
        ("doe de deur open", "open the door"),
        ("open the door", "open the door"),
        ("open the café's door", "open the café's door"),
    ],
)
def test_simple_orders(text: str, english: str) -> None:
    assert in_english(text) == english


@pytest.mark.parametrize(
    "text",
    ["otwórz drzwi", "打开冰箱", "открой дверь", "quelle heure est-il maintenant", "übersetze diesen brief", "¿?", ""],
)
def test_what_is_not_in_the_tables_is_not_english(text: str) -> None:
    assert in_english(text) is None
