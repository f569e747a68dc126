"""What a drawing shows, before it is drawn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from a4agent.offline.training.paints import Paint


@dataclass(frozen=True, eq=False)
class Patch:
    """One outline (n, 2) of one part in one material. Part 0 with `paint` None is a hole."""

    outline: np.ndarray
    part: int
    paint: Paint | None


@dataclass(frozen=True, eq=False)
class DrawnThing:
    """Pieces from back to front; y down. `upright` things stand, others lie at any angle."""

    kind: str
    pieces: list[Patch]
    upright: bool = False
