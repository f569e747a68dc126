"""The Thinker's answers as models really give them."""

from __future__ import annotations

import json
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from a4agent.errors import UnreadableAnswer
from a4agent.stages.target_json import json_values, read_target, thinking_in
from a4agent.testing import output

GOOD = '{"task": "drink", "object_name": "mug", "object_part": "the handle of the mug"}'
OTHER = '{"task": "drink", "object_name": "cup", "object_part": "the rim of the cup"}'


@pytest.mark.parametrize(
    "text",
    [
        GOOD,
        f"### Thinking\nhot body\n### Output\n{GOOD}",
        f"### Output\n```json\n{GOOD}\n```",
        f"### Output\n```\n{GOOD}\n```\nI hope this helps!",
        f"Sure! Here it is: {GOOD} Let me know.",
        GOOD.replace('mug"}', 'mug",}'),
        f"**### Output**\n{GOOD}",
        f"### output:\n{GOOD}",
        f"[{GOOD}]",
        f"[{GOOD}, {OTHER}]",
        f"{OTHER}\n### Output\n{GOOD}",
        f"{OTHER}\n{GOOD}",
        f"{GOOD}\n### Output\nas above",
        GOOD.replace("drink", "drink, then\nput it down"),
        f'{GOOD}\n{{"note": "no target in this one"}}',
        f"set {{x}} of [1, 2] and {{ {GOOD}",
        '{"object_name": " mug ", "object_part": "\\tthe handle of the mug\\n"}',
        f"### Output\n{GOOD}\n### Output\n{{broken",
        f'The 5" one:\n{GOOD[:-1]},}}\nIt is the "mug".',
        GOOD.replace('"drink"', 'null, "thinking": null'),
    ],
)
def test_an_answer_is_read_through_whatever_stands_around_it(text: str) -> None:
    target = read_target(text)
    assert (target.object_name, target.object_part) == ("mug", "the handle of the mug")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "empty"),
        (" \n\t", "empty"),
        ("I cannot see a mug.", "no JSON object"),
        ("{", "no JSON object"),
        ("[]", "no JSON object"),
        ("{}", "object_name"),
        ('{"object_name": "mug"}', "object_part"),
        ('{"object_name": "mug", "object_part": ""}', "object_part"),
        ('{"object_name": "mug", "object_part": ["a", "b"]}', "object_part"),
        ('{"object_name": 3, "object_part": "the handle"}', "object_name"),
        ('{"object_name": "mug", "object_part": "the [object part] of the [object name]"}', "template"),
        ("[1, 2, 3]", "JSON value"),
        (GOOD[:-5], "no JSON object"),
        ('{"object_name": ' + "1" * 5000 + "}", "no JSON object"),
    ],
)
def test_what_cannot_be_used_says_why(text: str, reason: str) -> None:
    with pytest.raises(UnreadableAnswer, match=reason):
        read_target(text)


def test_thinking_is_what_stands_between_its_heading_and_the_output() -> None:
    assert read_target(output("the lid of the jar", thinking="It turns.\nIt opens.")).thinking == "It turns.\nIt opens."


@pytest.mark.parametrize("text", [f"It is hot.\n```json\n{GOOD}\n```", f"It is hot. [{GOOD}]"])
def test_thinking_without_headings_ends_where_the_json_begins(text: str) -> None:
    assert read_target(text).thinking == "It is hot."


def test_thinking_may_be_a_field_of_the_json() -> None:
    answer = {"thinking": "hot", "object_name": "mug", "object_part": "the handle"}
    assert read_target(json.dumps(answer)).thinking == "hot"


def test_a_comma_inside_a_string_is_not_trailing() -> None:
    answer = {"task": "a, ] b, } c", "object_name": "mug", "object_part": "the handle"}
    assert read_target(json.dumps(answer)).task == "a, ] b, } c"


@given(st.text(max_size=300))
def test_any_text_is_read_or_refused(text: str) -> None:
    try:
        read_target(text)
    except UnreadableAnswer as error:
        assert str(error)


words = st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1, max_size=40).filter(str.strip)


@given(
    words,
    words.filter(lambda part: "[object part]" not in part),
    st.text(max_size=80).filter(lambda t: not set(t) & set('{["')),
)
def test_what_is_written_is_read_back(name: str, part: str, noise: str) -> None:
    if name.strip().lower() == "the name of the object":
        return
    target = read_target(f"{noise}\n{json.dumps({'object_name': name, 'object_part': part})}\n{noise}")
    assert (target.object_name, target.object_part) == (name.strip(), part.strip())


def test_many_openings_do_not_take_for_ever() -> None:
    assert list(json_values("{" * 100_000)) == []
    assert list(json_values("[" * 100_000 + "]" * 100_000)) == []


@pytest.mark.parametrize(
    "text",
    [
        "\n" * 100_000,
        '"\\' * 50_000,
        '"' * 100_001,
        ", " * 50_000,
        "[" * 100_000,
        "{" * 100_000,
        "# " * 50_000,
        "```" * 40_000,
        " \n> " * 30_000 + "{",
        "_" * 100_000 + "\n",
        "###" + " " * 100_000,
        '{"a": "' * 20_000,
    ],
    ids=lambda text: repr(text[:8]),
)
def test_hostile_answers_take_no_longer_than_their_length(text: str) -> None:
    started = time.process_time()
    with pytest.raises(UnreadableAnswer):
        read_target(text)
    thinking_in(text)
    assert time.process_time() - started < 2.0


def test_of_an_endless_answer_the_end_is_read() -> None:
    assert read_target("wait, " * 100_000 + output("the rim")).object_part == "the rim"


def test_a_stray_quote_hides_no_json() -> None:
    assert read_target('a 5" pipe\n{"object_name": "pipe", "object_part": "the end",}').object_part == "the end"


@pytest.mark.parametrize(
    ("text", "thinking"),
    [
        ("### Thinking\nThe body is hot.\n### Output\nnothing", "The body is hot."),
        ("The body is hot.\n### Output\n### Output\nnothing", "The body is hot.\n### Output"),
        ("### Thinking\nThe body is", "The body is"),
        (" The body is ", "The body is"),
    ],
)
def test_the_thinking_of_an_answer_without_a_target(text: str, thinking: str) -> None:
    assert thinking_in(text) == thinking
