"""What a profile lacks on this machine, and the command that gets it."""

from __future__ import annotations

from pathlib import Path

import pytest

from a4agent import requirements
from a4agent.config import load_settings
from a4agent.errors import ConfigError, MissingExtraError
from a4agent.experts import registry
from a4agent.files import toml
from a4agent.requirements import Missing, check_profile, check_settings
from a4agent.testing import ScriptedDetector

PROFILE = """
[spotter]
detector = "mine:detector"
segmenter = "offline:parts"
"""


@pytest.fixture
def profile(tmp_path: Path) -> Path:
    path = tmp_path / "mine.toml"
    path.write_text(PROFILE)
    return path


def detector_that(outcome: object) -> object:
    def create(model: str, role: str) -> object:
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    return create


def test_nothing_is_missing_when_all_is_here(profile: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(registry.plugins.added, "mine", detector_that(ScriptedDetector()))
    assert check_profile(str(profile)) == []


def test_a_missing_library_names_its_extra(profile: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(registry.plugins.added, "mine", detector_that(ScriptedDetector()))
    monkeypatch.setattr(requirements, "EXTRAS", {"offline": requirements.Extra(("json", "no_such_module_at_all"), "")})
    (missing,) = check_profile(str(profile))
    assert missing == Missing("the extra 'offline' (no_such_module_at_all)", "pip install 'a4agent[offline]'")


@pytest.mark.parametrize(
    ("error", "what", "fix"),
    [
        (MissingExtraError("'x' is not installed: pip install 'a4agent[api]'"), "not installed", "pip install"),
        (KeyError("mood"), "mine:detector cannot be made", "--set spotter.detector="),
        (ConfigError("no such mood"), "no such mood", "--set spotter.detector="),
    ],
)
def test_what_an_expert_lacks_when_it_is_built(
    error: Exception, what: str, fix: str, profile: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(registry.plugins.added, "mine", detector_that(error))
    (missing,) = check_profile(str(profile))
    assert what in missing.what
    assert missing.fix.startswith(fix)


def test_a_missing_key_is_an_export_and_a_missing_model_a_pull() -> None:
    missing = check_settings(load_settings("paper", environ={}))
    assert Missing("a key for openai:gpt-4o", "export OPENAI_API_KEY=...") in missing
    assert any(one.fix == "a4 models pull facebook/sam2.1-hiera-large" for one in missing)
    assert len(missing) == len(set(missing))


def test_a_model_that_is_a_folder_is_not_missing(tmp_path: Path) -> None:
    settings = load_settings("grounding-dino", {"spotter.segmenter": f"sam2:{tmp_path}"}, environ={})
    assert not any("sam2" in one.what for one in check_settings(settings))


def test_a_profile_that_does_not_exist_is_an_answer_not_an_error() -> None:
    (missing,) = check_profile("ofline")
    assert "did you mean 'offline'" in missing.what


def test_every_extra_is_looked_for() -> None:
    project = toml.loads((Path(__file__).parent.parent / "pyproject.toml").read_text())["project"]
    assert set(requirements.EXTRAS) == set(project["optional-dependencies"]) - {"all", "test"}
