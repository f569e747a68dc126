"""From "provider:model" to an expert.

A provider is an entry point of the group `a4agent.experts` that names a factory:

    [project.entry-points."a4agent.experts"]
    sam2 = "a4agent.experts.local.sam2:create"

    def create(model: str, role: Role, *, dtype: str = "auto", ...) -> Expert        or a class with this `__init__`

The keyword-only parameters of the factory are the expert's settings, so a misspelt setting is an error that
suggests the right one. Built-in experts register as third-party ones do. Nothing is imported before it is used.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Any, Union, cast, get_args, get_origin, get_type_hints

from a4agent.config import ExpertSettings
from a4agent.errors import ConfigError, UnknownNameError
from a4agent.plugins import Plugins
from a4agent.plugins import keywords_of as settings_of
from a4agent.protocols import VERBS, Expert, Role
from a4agent.redaction import reveal

Factory = Callable[..., Expert]
PLAIN: dict[Any, tuple[type, str]] = {
    bool: (bool, "true or false"),
    int: (Integral, "a whole number"),
    float: (Real, "a number"),
    str: (str, "a text (in quotes if it looks like a number)"),
    NoneType: (NoneType, ""),
}
"""The annotations of settings that are checked here: which values they take, and that in words."""

plugins = Plugins("a4agent.experts", "expert provider", "`a4 models list` shows what there is.")


register, providers = plugins.register, plugins.names
factory_of: Callable[[str], Factory] = plugins.find
"""The factory of a provider; see `Plugins.find` for its errors."""


def split(spec: str) -> tuple[str, str]:
    """ "sam2:large" -> ("sam2", "large").

    Raises:
        ConfigError: there is no colon.
    """
    provider, colon, model = spec.partition(":")
    if not colon or not provider:
        raise ConfigError(f"an expert is written 'provider:model' (such as 'sam2:tiny'), not {spec!r}")
    return provider, model


def module_of(spec: str) -> tuple[Any, str]:
    """The module of the factory behind a spec, which may say more about its models, and the model's name.

    Raises:
        UnknownNameError: no such provider.
        ConfigError: there is no colon, or the provider's module cannot be imported.
    """
    provider, model = split(spec)
    return sys.modules.get(factory_of(provider).__module__), model


def last_day(spec: str, settings: Mapping[str, Any]) -> str:
    """The day (ISO) on which the vendor stops serving a model, as far as this package knows; "" if unknown.

    The factory's module may define `last_day(model, settings)`. No server is asked.

    Raises:
        UnknownNameError: no such provider.
    """
    module, model = module_of(spec)
    return str(module.last_day(model, settings)) if hasattr(module, "last_day") else ""


def inner_experts(spec: str, settings: Mapping[str, Any]) -> dict[Role, tuple[str, dict[str, Any]]]:
    """The experts that the expert `spec` would build for itself, by role: their spec and settings.

    The setting of that name takes a built one instead, so that several experts can share it. A factory's
    module may define `inner_experts(model, settings)`.

    Raises:
        UnknownNameError: no such provider.
        ConfigError: an inner expert is not written "provider:model".
    """
    module, model = module_of(spec)
    found: dict[Role, tuple[str, dict[str, Any]]] = {}
    if hasattr(module, "inner_experts"):
        found = module.inner_experts(model, settings)
    for inner, _ in found.values():
        split(inner)
    return found


def create(spec: str, role: Role, settings: Mapping[str, Any] | None = None) -> Expert:
    """Build the expert `spec` for a role, with its settings.

    Raises:
        UnknownNameError: no such provider, or no such setting.
        ConfigError: the expert cannot play this role, or a setting has a value it does not take.
    """
    provider, model = split(spec)
    factory = factory_of(provider)
    values: dict[str, Any] = reveal(dict(settings or {}))
    known = settings_of(factory)
    if known is not None:
        for name in values:
            if name not in known:
                raise UnknownNameError.of(f"setting of {spec!r}:", name, known)
    _check_values(spec, factory, values)
    if isinstance(factory, type):
        _check_role(spec, factory, role)
    expert = factory(model, role, **values)
    _check_role(spec, expert, role)
    return expert


def _check_role(spec: str, expert: object, role: Role) -> None:
    if callable(getattr(expert, VERBS[role], None)):
        return
    hint = "; 'vlm-grounding:' makes a VLM a detector" if role == "detector" and hasattr(expert, "chat") else ""
    raise ConfigError(f"{spec!r} cannot be the {role}: it has no method {VERBS[role]!r}{hint}")


def build(specs: Mapping[str, ExpertSettings]) -> dict[str, Expert]:
    """Build the experts of `specs` ({"spotter.detector": ...}); those with equal settings are built once.

    Raises:
        UnknownNameError: an unknown provider or setting; the message suggests the nearest.
        ConfigError: an expert cannot play its role, or a setting has a value it does not take.
    """
    built: list[tuple[Role, ExpertSettings, Expert]] = []

    def one(spec: ExpertSettings, role: Role) -> Expert:
        for known_role, known, expert in built:
            if (known_role, known) == (role, spec):
                return expert
        inner = inner_experts(spec.expert, spec.settings)
        shared = {part: one(ExpertSettings(expert=name, **own), part) for part, (name, own) in inner.items()}
        expert = create(spec.expert, role, {**spec.settings, **shared})
        built.append((role, spec, expert))
        return expert

    return {name: one(spec, cast(Role, name.rpartition(".")[2])) for name, spec in specs.items()}


def _check_values(spec: str, factory: Factory, settings: Mapping[str, Any]) -> None:
    """Check values against the plain types of a factory's annotations; the factory checks the rest."""
    try:
        hints = get_type_hints(factory.__init__ if isinstance(factory, type) else factory)
    except Exception:  # annotations of a stranger's that only a type checker can read
        return
    for name, value in settings.items():
        hint = hints.get(name, Any)
        kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
        if all(kind in PLAIN for kind in kinds) and not any(_is_a(value, kind) for kind in kinds):
            words = " or ".join(PLAIN[kind][1] for kind in kinds if kind is not NoneType)
            raise ConfigError(f"setting {name!r} of {spec!r} takes {words}, not {value!r}")


def _is_a(value: Any, kind: type) -> bool:
    if isinstance(value, bool):  # which Python takes for a whole number
        return kind is bool
    return isinstance(value, PLAIN[kind][0])
