"""A machine that cannot render is told what to install."""

from __future__ import annotations

import os
import sys

import pytest

from a4agent.errors import MissingExtraError, ResourceError
from a4agent.sim import backend


def test_an_empty_picture_names_the_renderer(simulator: None) -> None:
    assert backend.check_renderer() == os.environ.get("MUJOCO_GL", "")


def test_a_renderer_that_fails_is_explained(simulator: None, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> object:
        raise RuntimeError("no display")

    monkeypatch.setattr(backend.mujoco(), "Renderer", broken)
    with pytest.raises(ResourceError, match=r"render off-screen here \(no display\).*libosmesa6"):
        backend.check_renderer()


def test_a_missing_simulator_names_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(MissingExtraError, match=r"a4agent\[sim\]"):
        backend.mujoco.__wrapped__()
