"""What a profile needs that this machine lacks, and the command that gets it. Nothing heavy is imported to find out."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Mapping
from dataclasses import dataclass

from a4agent.config import ExpertSettings, Settings, load_settings
from a4agent.errors import A4Error
from a4agent.experts import registry

EXTRAS: Mapping[str, tuple[str, ...]] = {
    "offline": ("onnxruntime", "skimage", "cv2"),
    "api": ("openai",),
    "local": ("torch", "transformers", "diffusers", "accelerate"),
    "bench": ("datasets", "pyarrow", "jinja2"),
    "serve": ("fastapi", "uvicorn", "multipart", "prometheus_client"),
    "app": ("gradio",),
    "ray": ("ray",),
    "interop": ("supervision", "rerun"),
    "sim": ("mujoco",),
}
"""Extra -> the modules it brings."""


@dataclass(frozen=True)
class Missing:
    """One thing that is not here: `what` in words and the command that `fix`es it."""

    what: str
    fix: str


def missing_modules(extra: str) -> list[str]:
    """The modules of an extra that cannot be found."""
    return [module for module in EXTRAS.get(extra, ()) if importlib.util.find_spec(module) is None]


def check_profile(name: str) -> list[Missing]:
    """What stands between this machine and a profile; empty if nothing does. Never raises."""
    try:
        settings = load_settings(name, environ={})
    except A4Error as error:
        return [Missing(str(error), f"correct the profile {name!r}")]
    return check_settings(settings)


def check_settings(settings: Settings) -> list[Missing]:
    """The same for settings that are merged already."""
    found = [
        Missing(f"the extra {extra!r} ({', '.join(modules)})", f"pip install 'a4agent[{extra}]'")
        for extra in settings.profile.needs
        if (modules := missing_modules(extra))
    ]
    for role, spec in settings.expert_specs().items():
        found += _check_expert(role, spec)
    return list(dict.fromkeys(found))


def _check_expert(role: str, spec: ExpertSettings) -> list[Missing]:
    """What the expert itself says: a factory may carry a function `missing(model, settings) -> [(what, fix)]`."""
    try:
        provider, model = registry.split(spec.expert)
        factory = registry.factory_of(provider)
        ask = getattr(factory, "missing", None)
        return [Missing(what, fix) for what, fix in ask(model, spec.settings)] if ask else []
    except A4Error as error:
        return [Missing(str(error), f"set {role} to an expert that is installed")]


def has_key(variable: str) -> bool:
    """Whether an API key is in the environment."""
    return bool(os.environ.get(variable, "").strip())
