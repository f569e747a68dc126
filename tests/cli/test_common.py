"""What the commands share."""

from __future__ import annotations

import pytest

from a4agent.cli import common
from a4agent.errors import ConfigError, InputError, ModelFilesError, RateLimited


def test_flags_become_settings_unless_they_are_none() -> None:
    settings = common.settings("offline", ["thinker.reasks=1"], engine__cache="read", engine__max_cost=None)
    assert settings.thinker is not None
    assert (settings.thinker.reasks, settings.engine.cache, settings.engine.max_cost) == (1, "read", None)


@pytest.mark.parametrize("text", ["", "=", "=1", "name"])
def test_a_set_without_a_name_or_a_value_is_explained(text: str) -> None:
    with pytest.raises(ConfigError, match="NAME=VALUE"):
        common.settings("offline", [text])


def test_the_users_mistakes_exit_with_2_and_others_with_1(capsys: pytest.CaptureFixture[str]) -> None:
    assert common.fail(InputError("no such [bold]image[/]: 'a.png'")) == common.USAGE
    assert common.fail(RateLimited("slow down")) == common.SOME_FAILED
    assert "no such [bold]image[/]: 'a.png'" in capsys.readouterr().err.replace("\n", " ")


def test_names_are_shown_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    common.say("plugin:a: [bold]runs/[x][/]")
    common.warn("plugin:a: [x]")
    assert capsys.readouterr().err == "plugin:a: [bold]runs/[x][/]\nwarning: plugin:a: [x]\n"


def test_missing_models_are_told_before_any_work() -> None:
    settings = common.settings("grounding-dino")
    with pytest.raises(ModelFilesError, match="a4 models pull"):
        common.build_agent(settings)
