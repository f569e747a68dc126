from __future__ import annotations

from pathlib import Path

import pytest

from a4agent.agent import A4Agent
from a4agent.config import Settings, load_settings, profile_names
from a4agent.errors import CredentialError, UnknownNameError
from a4agent.requirements import Missing
from a4agent.serve.profiles import Profiles
from a4agent.testing import scripted_agent


def test_models_are_loaded_once_and_those_of_another_profile_take_their_place() -> None:
    made: list[A4Agent] = []

    def load(settings: Settings) -> A4Agent:
        if settings.name == "paper":
            raise CredentialError("no key")
        made.append(scripted_agent())
        return made[-1]

    profiles = Profiles(load_settings, load, lambda settings: (), profile_names())
    first = profiles.agent("offline")
    assert profiles.agent("offline") is first
    second = profiles.agent("small")
    assert second is not first
    assert all(expert.closed for expert in first.experts())  # type: ignore[attr-defined]
    with pytest.raises(CredentialError):
        profiles.agent("paper")
    assert profiles.agent("small") is not second
    assert len(made) == 3
    profiles.close()
    profiles.close()


def test_what_is_said_of_a_profile() -> None:
    missing = [Missing("a GPU", "buy one")]
    profiles = Profiles(load_settings, lambda settings: scripted_agent(), lambda settings: missing, profile_names())
    assert profiles.dreams("paper")
    assert not profiles.dreams("offline")
    assert "GPT-4o" in profiles.summary("paper")
    assert profiles.missing("paper") == missing


def test_unreadable_settings_are_a_reason_not_a_crash() -> None:
    profiles = Profiles(load_settings, lambda settings: scripted_agent(), lambda settings: (), ["papre"])
    assert profiles.summary("papre") == "its settings cannot be read"
    assert not profiles.dreams("papre")
    (missing,) = profiles.missing("papre")
    assert "did you mean 'paper'" in missing.what


def test_a_visitors_profile_is_a_listed_name_and_never_a_path(tmp_path: Path) -> None:
    read: list[str] = []
    forged = tmp_path / "offline.toml"
    forged.write_text('[thinker.vlm]\nbase_url = "http://127.0.0.1:9"\napi_key_variable = "AWS_SECRET_ACCESS_KEY"\n')

    def settings(name: str) -> Settings:
        read.append(name)
        return load_settings(name)

    profiles = Profiles(settings, lambda settings: scripted_agent(), lambda settings: (), profile_names())
    for name in (str(forged), "offline.toml", "./offline", ""):
        with pytest.raises(UnknownNameError, match="choose one of"):
            profiles.agent(name)
        assert not profiles.dreams(name)
        assert "unknown profile" in profiles.missing(name)[0].what
    assert not read
