"""Settings: who wins, and what is said about misspellings."""

from __future__ import annotations

from pathlib import Path

import pytest

from a4agent.config import load_profile, load_settings, parse_value, profile_names
from a4agent.errors import A4Error, ConfigError, UnknownNameError
from a4agent.experts import registry

PROFILE = """
[profile]
summary = "for tests"
[dreamer]
vlm = "a:vlm"
editor = { expert = "a:editor", steps = 30 }
[thinker]
vlm = "a:vlm"
[spotter]
detector = "a:detector"
segmenter = { expert = "a:segmenter", dtype = "bf16", size = 4 }
"""


@pytest.fixture
def profile(tmp_path: Path) -> Path:
    path = tmp_path / "mine.toml"
    path.write_text(PROFILE)
    return path


def test_flags_beat_environment_beats_file_beats_profile(profile: Path, tmp_path: Path) -> None:
    folder = tmp_path / "work"
    folder.mkdir()
    (folder / "a4.toml").write_text(
        f"profile = '{profile}'\n[thinker]\nreasks = 1\nmax_tokens = 1\n[dreamer]\nseed = 1\n"
    )
    environ = {"A4_THINKER__MAX_TOKENS": "2", "A4_DREAMER__SEED": "2", "PATH": "/bin"}
    settings = load_settings(None, {"dreamer.seed": 3}, environ=environ, folder=folder)
    assert settings.name == "mine"
    assert settings.thinker is not None
    assert settings.dreamer is not None
    assert (settings.thinker.reasks, settings.thinker.max_tokens, settings.dreamer.seed) == (1, 2, 3)


def test_the_profile_is_chosen_by_flag_then_environment_then_file(profile: Path, tmp_path: Path) -> None:
    (tmp_path / "a4.toml").write_text("profile = 'offline'")
    environ = {"A4_PROFILE": str(profile)}
    assert load_settings(None, environ=environ, folder=tmp_path).name == "mine"
    assert load_settings("offline", environ=environ, folder=tmp_path).name == "offline"
    assert load_settings(None, environ={}, folder=tmp_path).name == "offline"


def test_replacing_an_expert_drops_the_settings_of_the_old_one(profile: Path) -> None:
    settings = load_settings(profile, {"spotter.segmenter": "b:other"}, environ={})
    assert settings.spotter.segmenter is not None
    assert settings.spotter.segmenter.settings == {}


@pytest.mark.parametrize(
    "overrides",
    [
        {"spotter.segmenter.dtype": "fp32"},
        {"spotter.segmenter": {"dtype": "fp32"}},
        {"spotter.segmenter": {"expert": "a:segmenter", "dtype": "fp32"}},
    ],
)
def test_a_setting_of_an_expert_leaves_its_others(profile: Path, overrides: dict[str, object]) -> None:
    segmenter = load_settings(profile, overrides, environ={}).spotter.segmenter
    assert segmenter is not None
    assert (segmenter.expert, segmenter.settings) == ("a:segmenter", {"dtype": "fp32", "size": 4})


@pytest.mark.parametrize("order", [1, -1])
def test_an_expert_and_its_setting_in_one_breath(profile: Path, order: int) -> None:
    pairs = [("spotter.segmenter", "b:other"), ("spotter.segmenter.dtype", "fp32")][::order]
    segmenter = load_settings(profile, dict(pairs), environ={}).spotter.segmenter
    assert segmenter is not None
    assert (segmenter.expert, segmenter.settings) == ("b:other", {"dtype": "fp32"})


@pytest.mark.parametrize("off", ["off", "none", False])
def test_stages_and_the_segmenter_can_be_switched_off(profile: Path, off: object) -> None:
    settings = load_settings(profile, {"dreamer": off, "thinker": off, "spotter.segmenter": off}, environ={})
    assert (settings.dreamer, settings.thinker, settings.spotter.segmenter) == (None, None, None)


def test_a_variable_may_hold_a_setting_of_an_expert(profile: Path) -> None:
    environ = {"A4_SPOTTER__SEGMENTER__SIZE": "8", "A4_THINKER": "off"}
    settings = load_settings(profile, environ=environ)
    assert settings.spotter.segmenter is not None
    assert settings.spotter.segmenter.settings["size"] == 8
    assert settings.thinker is None


@pytest.mark.parametrize(
    ("variable", "near"),
    [
        ("A4_PROFIL", "A4_PROFILE"),
        ("A4_SPOTTER__SEGMENTOR", "A4_SPOTTER__SEGMENTER"),
        ("A4_SPOTER__SEGMENTER", "A4_SPOTTER__SEGMENTER"),
        ("A4_ENGINE__MAXCOST", "A4_ENGINE__MAX_COST"),
    ],
)
def test_a_misspelt_variable_is_an_error_that_suggests_the_right_one(profile: Path, variable: str, near: str) -> None:
    with pytest.raises(UnknownNameError, match=f"{variable}.*{near}"):
        load_settings(profile, environ={variable: "x"})


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"spotter.segmentor": "a:b"}, "spotter.segmentor.*segmenter"),
        ({"thinker.reask": 1}, "thinker.reask.*reasks"),
        ({"engin.cache": "off"}, "engin.*engine"),
        ({"thinker.reasks": 9}, r"thinker\.reasks.*9"),
        ({"spotter.pairing": "best"}, "pairing.*optimal"),
        ({"spotter.detector": "nocolon"}, "provider:model"),
        ({"dreamer": "off", "dreamer.vlm": "a:b"}, "dreamer"),
        ({"engine.cache": "maybe"}, "cache"),
        ({"spotter.detector": "off"}, "provider:model'.*not 'off'$"),
        ({"spotter.segmenter": 5}, "provider:model'.*not 5$"),
        ({"spotter": 3}, "spotter' must be a table of settings, not 3"),
        ({"dreamer": "on"}, "table of settings or 'off'"),
        ({"profile": "paper"}, "--profile"),
        ({"name": "x"}, "unknown setting 'name'"),
        ({"ray.dreamers.replicas": 2}, "ray.dreamers.*did you mean 'dreamer'"),
        ({"ray.dreamer.gpus": 2}, "ray.dreamer.gpus.*did you mean 'num_gpus'"),
        ({"ray.dreamer.replicas": 0}, "ray.dreamer.replicas.*not 0"),
        ({"ray.dreamer.replicas": 1.5}, r"ray.dreamer.replicas.*not 1\.5"),
        ({"ray.dreamer.batch": 0}, "ray.dreamer.batch.*not 0"),
        ({"ray.dreamer.num_cpus": -1}, "ray.dreamer.num_cpus.*not -1"),
        ({"ray.dreamer.num_gpus": -0.5}, r"ray.dreamer.num_gpus.*not -0\.5"),
    ],
)
def test_settings_that_do_not_fit_are_explained(profile: Path, overrides: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load_settings(profile, overrides, environ={})


@pytest.mark.parametrize("text", ["profile = 3", "profile = ['offline']", "[profile]\nsummary = 'mine'"])
def test_a_profile_in_a_file_is_a_name(tmp_path: Path, text: str) -> None:
    (tmp_path / "a4.toml").write_text(text)
    with pytest.raises(ConfigError, match=r"a4\.toml' must be a name or a TOML file, such as 'offline'"):
        load_settings(environ={}, folder=tmp_path)


def test_an_error_names_where_the_setting_stands(profile: Path, tmp_path: Path) -> None:
    folder = tmp_path / "work"
    folder.mkdir()
    (folder / "a4.toml").write_text("[thinker]\nreasks = 9\n")
    with pytest.raises(ConfigError, match=r"reasks.*from .*a4\.toml"):
        load_settings(profile, environ={}, folder=folder)
    with pytest.raises(ConfigError, match=r"reasks.*from the environment"):
        load_settings(profile, environ={"A4_THINKER__REASKS": "8"}, folder=folder)
    (folder / "a4.toml").write_text("[thinker]\nreask = 1\n")
    with pytest.raises(UnknownNameError, match=r"reask.*from .*a4\.toml.*reasks"):
        load_settings(profile, environ={}, folder=folder)
    (folder / "a4.toml").write_text("[thinker]\nvlm = 'no colon'\n")  # wrong is what it stands for: its `expert`
    with pytest.raises(ConfigError, match=r"from .*a4\.toml.*not 'no colon'"):
        load_settings(profile, environ={}, folder=folder)


def test_a_blank_variable_is_as_good_as_none(profile: Path) -> None:
    environ = {"A4_SPOTTER__SEGMENTER": "", "A4_THINKER": "", "A4_PROFILE": ""}
    assert load_settings(profile, environ=environ) == load_settings(profile, environ={})


def test_switching_off_beats_the_settings_before_it(profile: Path) -> None:
    overrides = {"spotter.segmenter.dtype": "fp32", "spotter.segmenter": "off", "dreamer.seed": 3, "dreamer": "off"}
    settings = load_settings(profile, overrides, environ={})
    assert (settings.spotter.segmenter, settings.dreamer) == (None, None)


def test_a_profile_by_itself_knows_nothing_of_the_folder_and_the_environment(
    profile: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("A4_PROFIL", "misspelt")
    (tmp_path / "a4.toml").write_text("[thinker]\nreasks = 1\n")
    thinker = load_profile(profile).thinker
    assert thinker is not None
    assert thinker.reasks == 2


def test_a_missing_expert_says_how_to_give_it(tmp_path: Path) -> None:
    path = tmp_path / "half.toml"
    path.write_text("[thinker]\nvlm = 'a:b'\n")
    with pytest.raises(ConfigError, match="--set spotter"):
        load_settings(path, environ={})


def test_an_unknown_profile_suggests_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'offline'"):
        load_settings("ofline", environ={})


@pytest.mark.parametrize("text", ["[profile", "\xff"])
def test_a_broken_file_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "broken.toml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(ConfigError, match=r"broken\.toml"):
        load_settings(path, environ={})


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("4", 4),
        ("true", True),
        ("[1, 2]", [1, 2]),
        ("'4'", "4"),
        ("sam2:tiny", "sam2:tiny"),
        ("", ""),
        ("a = b", "a = b"),
    ],
)
def test_typed_values(text: str, value: object) -> None:
    assert parse_value(text) == value


@pytest.mark.parametrize("name", profile_names())
def test_every_profile_that_ships_fits_its_experts(name: str) -> None:
    """Settings named in a profile exist, whether or not its libraries are installed."""
    settings = load_settings(name, environ={})
    assert settings.profile.summary
    for role, spec in settings.expert_specs().items():
        provider, _ = registry.split(spec.expert)
        try:
            known = registry.settings_of(registry.factory_of(provider))
        except A4Error as error:  # pragma: no cover
            pytest.fail(f"{name}: {role}: {error}")
        assert known is None or set(spec.settings) <= set(known), f"{name}: {role}"


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"image": 5, "image.max_pixels": 3}, "'image.max_pixels' conflicts with image = 5"),
        ({"dreamer": "off", "dreamer.seed": 3}, "'dreamer.seed' conflicts with dreamer = 'off'"),
        ({"thinker": False, "thinker.reasks": 1}, "'thinker.reasks' conflicts with thinker = False"),
    ],
)
def test_a_table_that_is_replaced_has_no_settings(profile: Path, overrides: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load_settings(profile, overrides, environ={})
