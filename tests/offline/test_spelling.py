"""Spelling is mended towards words that are known, and nowhere else."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from a4agent.offline.knowledge import knowledge
from a4agent.offline.spelling import corrected


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("pikc up teh scisors", "pick up the scissors"),
        ("grabthe mug", "grab the mug"),
        ("peal the potatos", "peel the potatos"),
        ("opne the refridgerator", "open the refrigerator"),
        ("wich part of the tooth-brush", "which part of the toothbrush"),
    ],
)
def test_slips_are_mended(typed: str, meant: str) -> None:
    assert corrected(typed) == meant


@pytest.mark.parametrize(
    "word",
    [
        "casket",
        "ewer",
        "decanter",
        "hatch",
        "zorble",
        "sledge",
        "trivet",
        "glasses",
        "cutting",
        "potatos",
        "cat",
        "parka",
    ],
)
def test_other_words_stay(word: str) -> None:
    assert corrected(word) == word


def test_every_word_of_the_knowledge_base_stays() -> None:
    assert not {word for word in knowledge().written if corrected(word) != word.replace("-", "") and "-" not in word}


@given(st.text(alphabet=st.characters(exclude_categories=["Cs"])))
def test_any_text_can_be_corrected(text: str) -> None:
    corrected(text.lower())
