"""The model hub and its local cache: look up, ask, download. Nothing else connects to the hub.

    cached("facebook/sam2.1-hiera-tiny")    -> the snapshot's folder, or None; no network
    reach("facebook/sam3")                  asks whether it is there and open to this account, within seconds
    fetch("facebook/sam2.1-hiera-tiny")     -> the folder, downloaded; files that are there already are kept

Every error names the model and the command that fixes it. HF_HOME, HF_ENDPOINT, HF_TOKEN and
HF_HUB_OFFLINE mean what they always mean.
"""

from __future__ import annotations

import errno
import importlib.util
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from a4agent.errors import CredentialError, ModelFilesError, ResourceError, UnknownNameError, require
from a4agent.experts.checkpoint_files import missing_files
from a4agent.files import read_package_toml

PATTERNS = ["*.json", "*.safetensors", "*.txt", "*.jinja", "*.model"]
"""The files of a repository that loading needs; no pickled weights, and no code but that of `code = true`."""

_PROBE_SECONDS = 10.0
_ATTEMPTS, _PAUSE_SECONDS = 3, 1.0
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
_NOT_WRITABLE = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EEXIST)


def full_name(provider: str, model: str) -> str:
    """The folder or OWNER/NAME behind a provider's short name for it in models.toml ("tiny" of sam2).

    Raises:
        UnknownNameError: neither a short name nor a folder or OWNER/NAME.
    """
    short: dict[str, str] = read_package_toml("a4agent.experts", "models.toml")["local"][provider]
    if model in short or not short or "/" in model or "\\" in model or Path(model).expanduser().exists():
        return short.get(model, model)
    raise UnknownNameError.of(f"model of {provider!r}:", model, short, "A folder or OWNER/NAME also works.")


def reference(name: str, revision: str | None = None, file: str = "") -> str:
    """The argument of `a4 models pull` for it: OWNER/NAME, OWNER/NAME/FILE, OWNER/NAME@REVISION."""
    return "/".join(filter(None, (name, file))) + (f"@{revision}" if revision else "")


def patterns(name: str) -> list[str]:
    """PATTERNS, and "*.py" for a model that models.toml marks with `code = true`: its architecture is in there."""
    rows: list[dict[str, Any]] = read_package_toml("a4agent.experts", "models.toml")["model"]
    return [*PATTERNS, "*.py"] if any(row["name"] == name and row.get("code") for row in rows) else PATTERNS


def cached(name: str, revision: str | None = None, file: str = "") -> Path | None:
    """The complete snapshot of OWNER/NAME on this disk, or one file of it; None if it is not there. No network.

    Raises:
        ModelFilesError: no repository can have this name.
    """
    if importlib.util.find_spec("huggingface_hub") is None:
        return None
    hub, errors = _hub()
    try:
        if file:
            found = hub.try_to_load_from_cache(name, file, revision=revision)
            return Path(found) if isinstance(found, str) else None
        folder = hub.snapshot_download(name, revision=revision, allow_patterns=patterns(name), local_files_only=True)
    except errors.LocalEntryNotFoundError:
        return None
    except errors.HFValidationError as error:
        raise ModelFilesError(f"{name!r} is not a model name: {_first_line(error)}") from error
    # Of a snapshot that another program began, or an older client, the hub's client cannot tell whether it is whole.
    return None if missing_files(Path(folder)) else Path(folder)


def reach(name: str, revision: str | None = None, file: str = "") -> None:
    """Ask the hub whether it has OWNER/NAME, so that a missing model is reported before any work starts.

    `file` is the one that is wanted of it, for the message.

    Raises:
        ModelFilesError: it cannot be reached, or has no such model.
        CredentialError: the model is gated and this account has no access.
    """
    hub, _ = _hub()
    with _explained(name, revision, file):
        info = hub.HfApi().model_info(name, revision=revision, timeout=_PROBE_SECONDS)
        if info.gated:
            hub.HfApi().auth_check(name)


def fetch(name: str, revision: str | None = None, file: str = "") -> Path:
    """Download OWNER/NAME, or one file of it, into the cache; returns the snapshot's folder or the file.

    Raises:
        ModelFilesError: the hub cannot be reached, has no such model, revision or file, or broke off.
        CredentialError: the model is gated and this account has no access.
    """
    hub, _ = _hub()
    reach(name, revision, file)
    for attempts_left in reversed(range(_ATTEMPTS)):
        try:
            with _explained(name, revision, file):
                if file:
                    return Path(hub.hf_hub_download(name, file, revision=revision))
                return Path(hub.snapshot_download(name, revision=revision, allow_patterns=patterns(name)))
        except ModelFilesError as error:
            if not attempts_left or not _may_pass(error.__cause__):
                raise
            time.sleep(_PAUSE_SECONDS)
    raise AssertionError("the last attempt returns or raises")


def download_bytes(name: str, revision: str | None = None, file: str = "") -> int:
    """How many bytes `fetch` would download now.

    Raises:
        ModelFilesError, CredentialError: as `fetch`.
    """
    hub, _ = _hub()
    reach(name, revision, file)
    with _explained(name, revision, file):
        if file:
            plans = [hub.hf_hub_download(name, file, revision=revision, dry_run=True)]
        else:
            plans = hub.snapshot_download(name, revision=revision, allow_patterns=patterns(name), dry_run=True)
    return sum(int(plan.file_size) for plan in plans if plan.will_download)


def cache_folder() -> Path:
    """Where models are kept."""
    constants: Any = require("huggingface_hub.constants", extra="local")
    return Path(constants.HF_HUB_CACHE)


def _hub() -> tuple[Any, Any]:
    return require("huggingface_hub", extra="local"), require("huggingface_hub.errors", extra="local")


@contextmanager
def _explained(name: str, revision: str | None, file: str) -> Generator[None, None, None]:
    hub, errors = _hub()
    command = f"`a4 models pull {reference(name, revision, file)}`"
    pull = f"{command} where there is a network (or give a folder instead of the name)"
    if hub.constants.HF_HUB_OFFLINE:
        raise ModelFilesError(
            f"{name!r} is not on this machine, and HF_HUB_OFFLINE forbids downloading it: unset it, or run {pull}"
        )
    try:
        yield
    except errors.GatedRepoError as error:
        raise CredentialError(
            f"{name!r} is gated: accept its licence on the model's page, then `hf auth login` (or set HF_TOKEN)"
        ) from error
    except errors.RepositoryNotFoundError as error:
        raise ModelFilesError(
            f"there is neither a folder nor a model on the hub called {name!r} (a private one needs `hf auth login`)"
        ) from error
    except errors.RevisionNotFoundError as error:
        raise ModelFilesError(f"{name!r} has no revision {revision!r}") from error
    except (errors.LocalEntryNotFoundError, ConnectionError) as error:
        raise _unreachable(name, pull, error) from error
    except errors.EntryNotFoundError as error:
        raise ModelFilesError(f"{name!r} lacks a file: {_first_line(error)}") from error
    except Exception as error:  # the hub's client changes its HTTP library, and with it the classes, between versions
        number = getattr(error, "errno", None)
        if number in _DISK_FULL:
            raise ResourceError(f"the disk of {str(cache_folder())!r} is full; HF_HOME moves the cache") from error
        if number in _NOT_WRITABLE:
            raise ResourceError(
                f"{str(cache_folder())!r} cannot be written to ({_first_line(error)}); HF_HOME moves the cache"
            ) from error
        raise _unreachable(name, pull, error) from error


def _may_pass(cause: BaseException | None) -> bool:
    """Whether asking again may help: the connection failed, and the hub did not refuse."""
    _, errors = _hub()
    if isinstance(cause, errors.EntryNotFoundError):
        return isinstance(cause, errors.LocalEntryNotFoundError)
    return cause is not None and not isinstance(cause, (errors.RepositoryNotFoundError, errors.RevisionNotFoundError))


def _unreachable(name: str, pull: str, error: Exception) -> ModelFilesError:
    return ModelFilesError(
        f"{name!r} is not on this machine, and the hub could not be reached ({_first_line(error)}): run {pull}; "
        "HF_HUB_OFFLINE=1 stops all attempts"
    )


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__
