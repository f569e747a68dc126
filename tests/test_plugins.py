"""Names that packages register: found late, broken ones named."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from typing import Any

import pytest

from a4agent import plugins
from a4agent.errors import ConfigError, MissingExtraError, UnknownNameError
from a4agent.plugins import Plugins, keywords_of

GROUP = "a4agent.tests"


def installed(monkeypatch: pytest.MonkeyPatch, *points: tuple[str, str]) -> Plugins:
    found = [EntryPoint(name, value, GROUP) for name, value in points]
    monkeypatch.setattr(plugins, "entry_points", lambda group: found if group == GROUP else [])
    return Plugins(GROUP, "thing")


def test_an_entry_point_is_loaded_when_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    things = installed(monkeypatch, ("good", "json:loads"), ("bad", "no_such_module_here:x"))
    assert things.names() == ["bad", "good"]
    assert things.find("good")("[1]") == [1]


def test_what_a_process_adds_goes_first(monkeypatch: pytest.MonkeyPatch) -> None:
    things = installed(monkeypatch, ("good", "json:loads"))
    things.register("good", len)
    assert things.find("good") is len


def test_a_broken_package_is_a_warning_and_an_error_that_name_it(monkeypatch: pytest.MonkeyPatch) -> None:
    things = installed(monkeypatch, ("bad", "no_such_module_here:x"))
    with pytest.warns(UserWarning, match="thing 'bad' .no_such_module_here"), pytest.raises(ConfigError, match="bad"):
        things.find("bad")


def test_an_unknown_name_suggests_the_nearest(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UnknownNameError, match="unknown thing 'god'; did you mean 'good'"):
        installed(monkeypatch, ("good", "json:loads")).find("god")


def test_two_packages_of_one_name_are_a_warning_and_the_first_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    things = installed(monkeypatch, ("good", "json:loads"), ("good", "json:dumps"), ("good", "json:loads"))
    with pytest.warns(UserWarning, match="two packages register the thing 'good'; using json:loads"):
        assert things.names() == ["good"]


def test_our_own_errors_pass_through(monkeypatch: pytest.MonkeyPatch) -> None:
    things = installed(monkeypatch, ("lacking", "a4agent.no_such:x"))

    def lacking(self: EntryPoint) -> Any:
        raise MissingExtraError("pip install it")

    monkeypatch.setattr(EntryPoint, "load", lacking)
    with pytest.raises(MissingExtraError):
        things.find("lacking")


def test_the_keywords_of_a_factory_are_its_settings() -> None:
    def factory(model: str, role: str, *, size: int = 3, name: str = "") -> None: ...
    def any_setting(model: str, **settings: int) -> None: ...

    assert keywords_of(factory) == {"size": 3, "name": ""}
    assert keywords_of(any_setting) is None
