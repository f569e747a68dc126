"""What a profile needs that this machine lacks, and the command that gets it. Nothing heavy is imported to find out."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

from a4agent import models
from a4agent.config import ExpertSettings, Settings, load_profile
from a4agent.errors import A4Error, CredentialError, MissingExtraError
from a4agent.experts import registry
from a4agent.experts.base import Role

EXTRAS: Mapping[str, tuple[str, ...]] = {
    "offline": ("onnxruntime", "cv2"),
    "api": ("openai",),
    "local": ("torch", "transformers", "diffusers", "accelerate"),
    "bench": ("datasets", "pyarrow"),
    "serve": ("fastapi", "uvicorn", "multipart", "prometheus_client"),
    "app": ("gradio",),
    "ray": ("ray",),
    "interop": ("supervision", "rerun"),
    "sim": ("mujoco",),
    "quantisation": ("bitsandbytes",),
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
    """What stands between this machine and a profile by itself; empty if nothing does. Never raises."""
    try:
        settings = load_profile(name)
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
    experts = settings.expert_specs()
    try:
        needs = models.needs(experts)
    except A4Error as error:
        return [*found, Missing(str(error), "correct the profile or the --set that names it")]
    for need in needs:
        if need.path is None:
            size = f", {need.info.gigabytes:g} GB" if need.info.gigabytes else ""
            found.append(Missing(f"the model {need.name}{size}", f"a4 models pull {need.reference}"))
    with_checkpoints = {role for need in needs for role in need.roles}
    for role, spec in experts.items():
        if role not in with_checkpoints:
            found += _try_to_build(role, spec)
    return list(dict.fromkeys(found))


def _try_to_build(role: str, spec: ExpertSettings) -> list[Missing]:
    """An expert without a checkpoint is quickly made, and says itself what it lacks: a key, a library."""
    try:
        registry.create(spec.expert, cast(Role, role.rpartition(".")[2]), spec.settings).close()
    except CredentialError as error:
        variable = re.search(r"[A-Z][A-Z0-9]*_[A-Z0-9_]+", str(error))
        return [Missing(f"a key for {spec.expert}", f"export {variable[0]}=..." if variable else str(error))]
    except MissingExtraError as error:
        what, _, fix = str(error).rpartition(": ")
        return [Missing(what, fix)]
    except A4Error as error:
        return [Missing(f"{role}: {error}", f"--set {role}=PROVIDER:MODEL")]
    except Exception as error:  # somebody's expert that breaks
        return [Missing(f"{role}: {spec.expert} cannot be made: {error!r}", f"--set {role}=PROVIDER:MODEL")]
    return []
