"""The templates: to the letter, and the one-image variant differs in the second image alone."""

from __future__ import annotations

import difflib
import hashlib

import pytest

from a4agent import prompts
from a4agent.errors import ConfigError, UnknownNameError

SHA256 = {
    "dreamer": "cec6a32c89a7f6be6ec999942574bda7081aab4d461b5dd920f54541e1ae9b58",
    "thinker": "4d0299a7f27ae2bff69509dea8b916e1422a50c90fb8035e8c357154a89c4767",
}


@pytest.mark.parametrize("name", SHA256)
def test_the_papers_templates_are_shipped_to_the_letter(name: str) -> None:
    assert hashlib.sha256(prompts.load("paper", name).encode()).hexdigest() == SHA256[name]


def test_the_one_image_template_differs_only_about_the_second_image() -> None:
    two, one = (prompts.load("paper", name).splitlines() for name in ("thinker", "thinker_one_image"))
    changed = [line for line in difflib.ndiff(two, one) if line[0] in "+-"]
    removed = [line for line in changed if line[0] == "-"]
    assert len(removed) == 4
    assert all("image" in line for line in removed)
    assert not any("second" in line or "first" in line for line in one)


def test_the_instruction_takes_its_place() -> None:
    assert 'The task instruction is "open it". ' in prompts.fill(prompts.load("paper", "thinker"), "open it")
    assert prompts.fill(prompts.load("paper", "dreamer"), "open it").endswith("The given TASK is:\nopen it\n")


def test_a_folder_is_a_prompt_set(tmp_path: object) -> None:
    from pathlib import Path

    folder = Path(str(tmp_path))
    (folder / "thinker.txt").write_text("Which part?", encoding="utf-8")
    assert prompts.load(str(folder), "thinker") == "Which part?"
    with pytest.raises(ConfigError, match=r"dreamer\.txt"):
        prompts.load(str(folder), "dreamer")


def test_an_unknown_set_suggests_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'paper'"):
        prompts.load("papr", "thinker")


def test_hashes_tell_texts_apart() -> None:
    assert len({prompts.text_hash(*texts) for texts in [("ab", "c"), ("a", "bc"), ("abc",), ("abc", None)]}) == 4
