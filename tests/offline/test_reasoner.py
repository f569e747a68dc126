"""The reasoner speaks the Dreamer's and the Thinker's language, in the shipped templates."""

from __future__ import annotations

import json
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from a4agent import prompts
from a4agent.errors import RefusedAnswer, UnreadableAnswer
from a4agent.offline import create
from a4agent.offline.reasoner import dreamer_task, things_in, thinker_task
from a4agent.prompts import fill
from a4agent.protocols import ChatAnswer, ChatRequest

ONE, TWO, DREAM = (prompts.load("paper", name) for name in ("thinker_one_image", "thinker", "dreamer"))


def ask(text: str) -> str:
    answer = create("reasoner", "vlm").chat([ChatRequest(images=(Image.new("RGB", (8, 8)),), text=text)])[0]
    assert isinstance(answer, ChatAnswer)
    return answer.text


@pytest.mark.parametrize("template", [ONE, TWO])
def test_the_thinkers_form(template: str) -> None:
    answer = ask(fill(template, "open the refrigerator"))
    assert answer.startswith("### Thinking\n")
    output = json.loads(answer.partition("### Output")[2])
    assert output == {
        "task": "open the refrigerator",
        "object_name": "refrigerator",
        "object_part": "the handle of the refrigerator",
    }


def test_a_refusal_is_one_plain_sentence_with_an_example() -> None:
    request = ChatRequest(images=(), text=fill(TWO, "translate this letter"))
    answer = create("reasoner", "vlm").chat([request])[0]
    assert isinstance(answer, RefusedAnswer)
    assert str(answer) == (
        "I do not know which part of which thing is meant by 'translate this letter'. "
        "Try 'open the drawer' or 'pick up the mug'."
    )


def test_what_the_network_sees_meets_the_words(monkeypatch: pytest.MonkeyPatch) -> None:
    mug = SimpleNamespace(kinds={"mug": 0.9, "knife": 0.004, "spoon": 0.05, "none": 0.046}, likeliest=("mug", 0.9))
    seen = [mug, SimpleNamespace(kinds={"none": 1.0}, likeliest=("none", 1.0))]
    monkeypatch.setattr("a4agent.offline.eye.look", lambda image, threads: seen)
    assert things_in(Image.new("RGB", (8, 8))) == (("mug",), frozenset(["knife"]), frozenset(["knife", "spoon"]))
    assert '"the handle of the mug"' in ask(fill(TWO, "drink from this"))
    assert "I see no knife: the picture shows a mug." in ask(fill(TWO, "cut the bread"))


def test_the_dreamers_form() -> None:
    prompt = ask(fill(DREAM, "drink from the mug"))
    assert prompt.startswith("Edit the input image to ")
    assert prompt.endswith("keep others unchanged")
    assert "the handle of the mug" in prompt
    assert "\n" not in prompt


def test_the_dreamer_is_answered_even_where_the_part_is_not_known() -> None:
    prompt = ask(fill(DREAM, "translate this"))
    assert prompt.startswith("Edit the input image to ")
    assert prompt.endswith("keep others unchanged")


def test_another_prompt_is_refused_with_the_way_out() -> None:
    answer = create("reasoner", "vlm").chat([ChatRequest(images=(), text="What is the capital of France?")])[0]
    assert isinstance(answer, UnreadableAnswer)
    assert "thinker.vlm" in str(answer)


@given(st.text(alphabet=st.characters(exclude_categories=["Cs"]), min_size=1).filter(lambda text: text.strip()))
def test_the_task_comes_out_of_the_templates_as_it_went_in(task: str) -> None:
    if '". ' in task or '".\n' in task:
        return  # looks like the end of the task
    assert thinker_task(fill(TWO, task)) == task.strip()
    assert dreamer_task(fill(DREAM, task)) == task.strip().strip('"')


@given(st.text())
def test_it_has_an_answer_to_everything(task: str) -> None:
    answer = create("reasoner", "vlm").chat([ChatRequest(images=(), text=fill(TWO, task.replace('"', "'")))])[0]
    assert isinstance(answer, RefusedAnswer) or (isinstance(answer, ChatAnswer) and "### Output" in answer.text)


def test_a_batch_keeps_its_order() -> None:
    tasks = ["hold the spoon", "hold the fork", "hold the knife"]
    answers = create("reasoner", "vlm").chat([ChatRequest(images=(), text=fill(TWO, task)) for task in tasks])
    assert [json.loads(a.text.partition("### Output")[2])["object_name"] for a in answers] == ["spoon", "fork", "knife"]
