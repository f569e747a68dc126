"""Settings: flags over environment over `a4.toml` over profile, checked once, with suggestions for misspelt names.

    a4 predict mug.jpg "drink" --profile paper --set spotter.segmenter=sam2:tiny    flags
    A4_SPOTTER__SEGMENTER=sam2:tiny A4_PROFILE=paper                                 environment
    a4.toml: profile = "paper"; [spotter] segmenter = "sam2:tiny"                    file in the working folder
    profiles/paper.toml                                                              profile

An expert is "provider:model" or a table {expert = "provider:model", SETTING = VALUE}; a stage or the
segmenter is switched off with "off". Replacing an expert drops the settings of the one it replaces.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, cast, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_serializer, model_validator

from a4agent.errors import ConfigError, UnknownNameError, nearest
from a4agent.files import read_toml, toml
from a4agent.imaging.load import MAX_PIXELS
from a4agent.redaction import conceal, redact

PROFILES = Path(__file__).parent / "profiles"
FILE = "a4.toml"
PREFIX = "A4_"
OTHER_VARIABLES = frozenset({"A4_CACHE_DIR", "A4_SERVER_TOKEN"})
STAGES = ("dreamer", "thinker", "spotter", "verifier")
AN_EXPERT = "an expert is 'provider:model', such as 'sam2:tiny'"
OFF = ("off", "none", False)


class SettingsTable(BaseModel):
    """A table of settings; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class ExpertSettings(BaseModel):
    """The expert that plays a role; other keys are the expert's settings."""

    model_config = ConfigDict(extra="allow", frozen=True)

    expert: str

    @model_validator(mode="before")
    @classmethod
    def _from_text(cls, value: Any) -> Any:
        value = conceal(value)
        if not isinstance(value, (str, Mapping, ExpertSettings)):
            raise ValueError(f"{AN_EXPERT}, not {value!r}")
        return {"expert": value} if isinstance(value, str) else cast("Any", value)

    @field_validator("expert")
    @classmethod
    def _has_a_provider(cls, value: str) -> str:
        if ":" not in value or value.startswith(":"):
            raise ValueError(f"{AN_EXPERT}, not {value!r}")
        return value

    @model_serializer
    def _without_secrets(self) -> dict[str, Any]:
        return redact({"expert": self.expert, **self.settings})

    @property
    def settings(self) -> dict[str, Any]:
        """The expert's own settings, secrets as `redaction.Secret`."""
        return dict(self.model_extra or {})


class DreamerSettings(SettingsTable):
    vlm: ExpertSettings
    editor: ExpertSettings
    prompts: str = "paper"
    seed: int = 0
    max_tokens: int = Field(default=512, gt=0)
    required: bool = False


class ThinkerSettings(SettingsTable):
    vlm: ExpertSettings
    prompts: str = "paper"
    max_tokens: int = Field(default=2048, gt=0)
    reasks: int = Field(default=2, ge=0, le=5)
    structured: bool = False


class SpotterSettings(SettingsTable):
    detector: ExpertSettings
    segmenter: ExpertSettings | None = None
    pairing: Literal["optimal", "paper", "inside"] = "optimal"


class VerifierSettings(SettingsTable):
    """The checks after the Spotter and their experts; see `a4agent.stages.verifier`.

    Without a `vlm` of its own the Verifier asks the Thinker's.
    """

    signals: list[str] = ["geometry"]
    accept: float = Field(default=0.5, ge=0, le=1)
    retries: int = Field(default=2, ge=0, le=5)
    calibration: str | None = None
    vlm: ExpertSettings | None = None
    detector: ExpertSettings | None = None
    segmenter: ExpertSettings | None = None
    prompts: str = "verifier"
    max_tokens: int = Field(default=1024, gt=0)


class ImageSettings(SettingsTable):
    max_pixels: int = Field(default=MAX_PIXELS, gt=0)


class EngineSettings(SettingsTable):
    """How many samples run at once, and what stops a run; see `a4agent.engine`."""

    cache: Literal["off", "read", "write"] = "off"
    cache_dir: Path | None = None
    cache_gb: float = Field(default=20.0, gt=0)
    in_flight: int | None = Field(default=None, gt=0)
    batch_wait_ms: float = Field(default=4.0, ge=0)
    retries: int = Field(default=4, ge=0)
    retry_wait: float = Field(default=0.5, ge=0)
    max_retry_after: float = Field(default=120.0, ge=0)
    outage_seconds: float = Field(default=300.0, gt=0)
    max_cost: float | None = Field(default=None, ge=0)
    max_seconds: float | None = Field(default=None, gt=0)
    max_sample_seconds: float | None = Field(default=None, gt=0)


class RayPool(SettingsTable):
    """The Ray actors of one stage: how many, what each gets, and how many calls it takes at once."""

    replicas: int = Field(default=1, ge=1)
    num_cpus: float = Field(default=0.5, ge=0)
    num_gpus: float = Field(default=0.0, ge=0)
    batch: int = Field(default=16, ge=1)


class RaySettings(SettingsTable):
    """The pool of each stage; see `a4agent.ray_engine`."""

    dreamer: RayPool = RayPool()
    thinker: RayPool = RayPool()
    spotter: RayPool = RayPool()
    verifier: RayPool = RayPool()


class ProfileInfo(SettingsTable):
    """A profile's description for people. `licences` are those of models that models.toml does not list."""

    summary: str = ""
    memory: str = ""
    licences: list[str] = []
    notes: str = ""


class Settings(SettingsTable):
    """All settings of one agent, after merging."""

    name: str
    profile: ProfileInfo = ProfileInfo()
    dreamer: DreamerSettings | None = None
    thinker: ThinkerSettings | None = None
    spotter: SpotterSettings
    verifier: VerifierSettings | None = None
    image: ImageSettings = ImageSettings()
    engine: EngineSettings = EngineSettings()
    ray: RaySettings = RaySettings()

    def expert_specs(self) -> dict[str, ExpertSettings]:
        """The experts by the dotted name of their role ("spotter.detector"), in the order of the stages."""
        found: dict[str, ExpertSettings] = {}
        for stage in STAGES:
            table = getattr(self, stage)
            for role in type(table).model_fields if table else ():
                if isinstance(value := getattr(table, role), ExpertSettings):
                    found[f"{stage}.{role}"] = value
        return found


def profile_names() -> list[str]:
    """The profiles that come with the package."""
    return sorted(path.stem for path in PROFILES.glob("*.toml"))


def load_settings(
    profile: str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    *,
    environ: Mapping[str, str] | None = None,
    folder: Path | None = None,
) -> Settings:
    """Merge and check the settings; `overrides` maps dotted names to values ({"spotter.segmenter": "sam2:tiny"}).

    Raises:
        UnknownNameError: an unknown profile, setting or `A4_` variable; the message suggests the nearest.
        ConfigError: an invalid value, or a file that is not TOML; the message names the source.
    """
    from_environment = _read_environment(os.environ if environ is None else environ)
    path = (folder or Path.cwd()) / FILE
    from_file = read_toml(path) if path.is_file() else {}
    named = from_file.pop("profile", None)
    if named is not None and not isinstance(named, str):
        raise ConfigError(f"profile = {named!r} in {str(path)!r} must be a name or a TOML file, such as 'offline'")
    chosen = profile or from_environment.pop("profile", None) or named or "offline"
    from_environment.pop("profile", None)
    return _merge(chosen, {str(path): from_file, "the environment": from_environment, "": _nested(overrides or {})})


def load_profile(profile: str | Path) -> Settings:
    """A profile by itself, without the environment and `a4.toml`.

    Raises:
        UnknownNameError: an unknown profile or setting; the message suggests the nearest.
        ConfigError: an invalid value, or a file that is not TOML.
    """
    return _merge(profile, {})


def _merge(profile: str | Path, layers: Mapping[str, dict[str, Any]]) -> Settings:
    """The settings of a profile under layers, named by their sources; the last layer wins."""
    merged = conceal(_read_profile(profile))
    layers = {source: conceal(layer) for source, layer in layers.items()}
    for source, layer in layers.items():
        if "name" in layer:  # the profile's own; no layer may set it
            raise _unknown_setting(["name"], _from(source))
        _overlay(merged, layer)
    merged["name"] = Path(profile).stem if str(profile).endswith(".toml") else str(profile)
    try:
        return Settings.model_validate(merged)
    except ValidationError as error:
        raise _explained(error, str(profile), layers) from error


def parse_value(text: str) -> Any:
    """A value from a command line or a variable: TOML if it parses (4, true, [1, 2], "x"), else the text."""
    try:
        return toml.loads(f"value = {text}")["value"]
    except (toml.TOMLDecodeError, KeyError):
        return text


def _read_profile(profile: str | Path) -> dict[str, Any]:
    path = Path(profile)
    if path.suffix == ".toml":
        return read_toml(path)
    if str(profile) not in profile_names():
        raise UnknownNameError.of("profile", str(profile), profile_names(), "`a4 profiles` lists them.")
    return read_toml(PROFILES / f"{profile}.toml")


def _read_environment(environ: Mapping[str, str]) -> dict[str, Any]:
    """The `A4_*` variables as nested settings: A4_SPOTTER__SEGMENTER=sam2:tiny."""
    known = _variable_names()
    found: dict[str, Any] = {}
    for variable, text in environ.items():
        if not variable.startswith(PREFIX) or variable in OTHER_VARIABLES:
            continue
        if variable not in known and not any(variable.startswith(f"{name}__") for name in _expert_variables()):
            raise UnknownNameError.of("environment variable", variable, known | OTHER_VARIABLES)
        if not text:  # how shells and compose files leave a variable out
            continue
        keys = variable.removeprefix(PREFIX).lower().split("__")
        _put(found, keys, text if keys == ["profile"] else parse_value(text))
    return found


def _variable_names() -> set[str]:
    names = {"A4_PROFILE"}
    for section, field in Settings.model_fields.items():
        table = _table_of(field.annotation)
        if table is None or section == "profile":
            continue
        names |= {f"{PREFIX}{section.upper()}"} if section in STAGES else set()
        names |= {f"{PREFIX}{section.upper()}__{name.upper()}" for name in table.model_fields}
    return names


def _expert_variables() -> list[str]:
    """The variables of experts, whose own settings may follow: A4_SPOTTER__DETECTOR__MARGIN."""
    return [
        f"{PREFIX}{stage.upper()}__{role.upper()}"
        for stage in STAGES
        if (table := _table_of(Settings.model_fields[stage].annotation))
        for role, field in table.model_fields.items()
        if ExpertSettings in (field.annotation, *get_args(field.annotation))
    ]


def _table_of(annotation: Any) -> type[BaseModel] | None:
    for kind in getattr(annotation, "__args__", (annotation,)):
        if isinstance(kind, type) and issubclass(kind, SettingsTable):
            return kind
    return None


def _nested(dotted: Mapping[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in dotted.items():
        _put(found, name.split("."), value)
    return found


def _put(tree: dict[str, Any], keys: list[str], value: Any) -> None:
    for key in keys[:-1]:
        below = tree.setdefault(key, {})
        if isinstance(below, str) and below not in OFF:  # "spotter.segmenter" and then "spotter.segmenter.dtype"
            below = tree[key] = {"expert": below}
        if not isinstance(below, dict):
            raise ConfigError(f"setting {'.'.join(keys)!r} conflicts with {key} = {below!r}; remove one")
        tree = cast("dict[str, Any]", below)
    last = keys[-1]
    if isinstance(value, str) and value not in OFF and isinstance(tree.get(last), dict):
        value = {**tree[last], "expert": value}
    tree[last] = value


def _overlay(base: dict[str, Any], layer: Mapping[str, Any]) -> None:
    """Lay `layer` over `base`: tables merge, other values replace; "off" and False switch a table off."""
    for key, value in layer.items():
        below = base.get(key)
        if (key in STAGES or key == "segmenter") and value in OFF:
            base[key] = None
        elif isinstance(value, Mapping):
            if isinstance(below, str):
                below = {"expert": below}
            if not isinstance(below, dict) or value.get("expert", below.get("expert")) != below.get("expert"):
                below = {}
            merged = copy.deepcopy(cast("dict[str, Any]", below))
            _overlay(merged, cast("Mapping[str, Any]", value))
            base[key] = merged
        else:
            base[key] = value


def _explained(error: ValidationError, profile: str, layers: Mapping[str, dict[str, Any]]) -> ConfigError:
    first = error.errors()[0]
    place = [str(part) for part in first["loc"]]
    name = ".".join(place)
    setters = (source for source, layer in reversed(list(layers.items())) if _stands_in(layer, place))
    where = _from(next(setters, f"profile {profile!r}"))
    if first["type"] == "extra_forbidden":
        return _unknown_setting(place, where)
    if first["type"] == "missing":
        return ConfigError(f"the setting {name!r} is missing from profile {profile!r}; add --set {name}=VALUE")
    if name == "profile":
        return ConfigError(f"setting 'profile'{where}: choose a profile with --profile or A4_PROFILE")
    if first["type"] == "value_error":
        return ConfigError(f"setting {name!r}{where}: {first['msg'].removeprefix('Value error, ')}")
    if first["type"] in ("model_type", "model_attributes_type"):
        off = " or 'off'" if name in ("dreamer", "thinker", "verifier") else ""
        return ConfigError(f"setting {name!r}{where} must be a table of settings{off}, not {first['input']!r}")
    return ConfigError(f"setting {name!r}{where}: {first['msg']}, not {first['input']!r}")


def _from(source: str) -> str:
    return f" (from {source})" if source else ""


def _unknown_setting(place: list[str], where: str = "") -> UnknownNameError:
    table: type[BaseModel] | None = Settings
    for part in place[:-1]:
        field = table.model_fields.get(part) if table else None
        table = _table_of(field.annotation) if field else None
    known = [name for name in table.model_fields if name != "name"] if table else []
    near = nearest(place[-1], known)
    guess = f"did you mean {near!r}?" if near else f"known: {', '.join(known)}."
    return UnknownNameError(f"unknown setting {'.'.join(place)!r}{where}; {guess}")


def _stands_in(layer: Any, place: list[str]) -> bool:
    """Whether a layer sets the value at `place`, or a single value above it."""
    for part in place:
        if not isinstance(layer, Mapping):
            return True
        if part not in layer:
            return False
        layer = cast("Mapping[str, Any]", layer)[part]
    return True
