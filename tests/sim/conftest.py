"""Everything here renders: it needs mujoco, an off-screen renderer and the asset packages."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from a4agent.sim.catalogue import Catalogue, built_in
from a4agent.sim.draw import Drawn, Plan, draw_sample
from a4agent.sim.make import make_set


@pytest.fixture(scope="session")
def catalogue(simulator: None) -> Catalogue:
    return built_in()


@pytest.fixture(scope="session")
def made(catalogue: Catalogue, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set of 24 samples of all things."""
    return make_set(tmp_path_factory.mktemp("sim") / "set", n=24, seed=5, split=None, workers=2)


@pytest.fixture(scope="session")
def rows(made: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (made / "samples.jsonl").read_text(encoding="utf-8").splitlines()]


@pytest.fixture(scope="session")
def drawn(catalogue: Catalogue) -> dict[str, Drawn]:
    """One sample each of a handle, a kitchen with two answers, and something small that lies flat."""
    wanted = {"drawer": 0, "sink cabinet": 1, "dial": 0}
    return {
        name: draw_sample(catalogue, Plan(3, index, catalogue.thing(name), catalogue.thing(name).tasks[task]))
        for index, (name, task) in enumerate(wanted.items())
    }
