"""Each published layout as a fixture."""

from __future__ import annotations

from pathlib import Path

import pytest

import layouts


@pytest.fixture
def folder_path(tmp_path: Path) -> Path:
    return layouts.write_folder(tmp_path)


@pytest.fixture
def ragnet_path(tmp_path: Path) -> Path:
    return layouts.write_ragnet(tmp_path)


@pytest.fixture
def umd_path(tmp_path: Path) -> Path:
    return layouts.write_umd(tmp_path)


@pytest.fixture
def instructpart_path(tmp_path: Path) -> Path:
    return layouts.write_instructpart(tmp_path)


@pytest.fixture
def reasonaff_path(tmp_path: Path) -> Path:
    return layouts.write_reasonaff(tmp_path)


@pytest.fixture
def coco_path(tmp_path: Path) -> Path:
    return layouts.write_coco(tmp_path)
