"""Where the assets are, and what to type where they are not."""

from __future__ import annotations

import sys

import pytest

from a4agent.errors import DataError, MissingExtraError
from a4agent.sim.assets import asset_path, check_installed, install_command
from a4agent.sim.catalogue import Catalogue, Package, built_in


def _with(name: str, **changes: str) -> Catalogue:
    known = built_in()
    package = known.packages["metaworld"].model_copy(update=changes)
    return known.model_copy(update={"packages": {name: package}})


def test_every_declared_file_is_there(catalogue: Catalogue) -> None:
    for entry in (*catalogue.things, *catalogue.props, *catalogue.arms):
        assert asset_path(catalogue, entry.package, entry.file).is_file()
    for surface in catalogue.surfaces:
        for file in surface.files:
            assert asset_path(catalogue, surface.package, file).is_file()


def test_asset_packages_are_read_and_never_imported(made: object) -> None:
    assert not {"metaworld", "robosuite", "gymnasium_robotics"} & set(sys.modules)


def test_what_is_missing_is_named_with_its_command() -> None:
    with pytest.raises(MissingExtraError, match=r"assets of not-there are .* pip install --no-deps not-there==3\.1\.1"):
        check_installed(_with("not-there"))
    with pytest.raises(MissingExtraError, match=r"pip install --no-deps not-there==3\.1\.1"):
        asset_path(_with("not-there"), "not-there", "a.xml")


def test_another_version_without_the_file_says_which_has_it(catalogue: Catalogue) -> None:
    with pytest.raises(MissingExtraError, match=r"metaworld 3\.\S+ has no 'gone\.xml'; version 9\.9 has"):
        asset_path(_with("metaworld", version="9.9"), "metaworld", "gone.xml")


def test_a_file_that_the_declared_version_does_not_have_is_a_wrong_declaration(catalogue: Catalogue) -> None:
    with pytest.raises(DataError, match=r"has no 'gone\.xml' in its folder 'metaworld/assets'"):
        asset_path(_with("metaworld"), "metaworld", "gone.xml")


def test_one_command_installs_all() -> None:
    packages: dict[str, Package] = built_in().packages
    assert install_command(built_in()) == "pip install --no-deps " + " ".join(
        f"{name}=={package.version}" for name, package in packages.items()
    )
