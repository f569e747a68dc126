"""An object seen along its longest axis: how wide it is and what colour it has at each step from end to end.

    profile = Profile.of(silhouette)        # 64 steps
    profile.cut(Layout(grip=0.65, width=1.9)) -> (0.34, 1.0), (0.0, 0.34): grip and working end

Most tools are a grip and a working end. Where one becomes the other is where width and colour change
most, weighed against what is known of such tools: a `Layout`. Both directions compete.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

STEPS = 64
Span = tuple[float, float]
"""From where to where, as shares of the object's length."""


@dataclass(frozen=True)
class Layout:
    """What is known of a family of tools.

    `grip` is the grip's share of the length; `width` how much wider the working end is than the grip;
    `steel` whether the working end is usually bare metal.
    """

    grip: float = 0.6
    width: float = 1.4
    steel: bool = False


@dataclass(frozen=True, eq=False)
class Profile:
    """`positions` (h, w) float32 from 0 to 1 along the axis; per step: `widths` in pixels, `colours` (n, 3)."""

    mask: np.ndarray
    positions: np.ndarray
    widths: np.ndarray
    colours: np.ndarray
    elongation: float

    @classmethod
    def of(cls, mask: np.ndarray, lab: np.ndarray) -> Profile:
        """Measure a mask (h, w) bool that is not blank."""
        points = np.argwhere(mask)[:, ::-1].astype(np.float64)
        middle = points.mean(0)
        variances, axes = np.linalg.eigh(np.cov((points - middle).T, bias=True) + 1e-6 * np.eye(2))
        grid_y, grid_x = np.mgrid[: mask.shape[0], : mask.shape[1]]
        along = (grid_x - middle[0]) * axes[0, 1] + (grid_y - middle[1]) * axes[1, 1]
        start, end = along[mask].min(), along[mask].max()
        positions = ((along - start) / max(end - start, 1e-6)).astype(np.float32)
        steps = np.clip((positions[mask] * STEPS).astype(int), 0, STEPS - 1)
        counts = np.bincount(steps, minlength=STEPS).astype(np.float64)
        colours = np.stack([np.bincount(steps, weights=channel, minlength=STEPS) for channel in lab[mask].T], axis=1)
        filled = np.flatnonzero(counts)
        colours = colours / np.maximum(counts, 1.0)[:, None]
        colours = np.stack([np.interp(range(STEPS), filled, channel[filled]) for channel in colours.T], axis=1)
        widths = np.interp(range(STEPS), filled, counts[filled]) / max((end - start) / STEPS, 1e-6)
        elongation = float(np.sqrt(variances[1] / max(variances[0], 1e-6)))
        return cls(mask, positions, widths, colours, elongation)

    def between(self, start: float, end: float) -> np.ndarray:
        """The slice (h, w) bool of the object from `start` to `end`, shares of its length."""
        return self.mask & (self.positions >= start) & (self.positions <= end)

    def cut(self, layout: Layout) -> tuple[Span, Span]:
        """Where the grip lies and where the working end."""
        costs = [evidence.costs(layout) for evidence in self._evidence]
        flipped = bool(min(costs[1]) < min(costs[0]))
        share = float(CUTS[np.argmin(costs[flipped])] / STEPS)
        if flipped:
            return (1.0 - share, 1.0), (0.0, 1.0 - share)
        return (0.0, share), (share, 1.0)

    @cached_property
    def _evidence(self) -> tuple[_Evidence, _Evidence]:
        """For the grip at the start of the axis, and at its end."""
        widths = np.maximum(self.widths, 1.0)
        return _Evidence.of(widths, self.colours), _Evidence.of(widths[::-1], self.colours[::-1])


CUTS = np.arange(6, STEPS - 5)
"""After how many steps of grip an object may be cut."""


@dataclass(frozen=True, eq=False)
class _Evidence:
    """What the picture says for each of CUTS: the share of the variation that it explains, the size of the step in
    width and colour there, the log of how much wider the working end is, and how much greyer."""

    explained: np.ndarray
    step: np.ndarray
    wider: np.ndarray
    greyer: np.ndarray

    @classmethod
    def of(cls, widths: np.ndarray, colours: np.ndarray) -> _Evidence:
        features = np.concatenate([1.6 * np.log2(widths)[:, None], colours / 10.0], axis=1)
        features = features - features.mean(0)
        total = (features**2).sum()
        before = np.cumsum(features, axis=0)[CUTS - 1]
        between = (before**2).sum(1) / CUTS + ((features.sum(0) - before) ** 2).sum(1) / (STEPS - CUTS)
        near = [features[k - 3 : k].mean(0) - features[k : k + 3].mean(0) for k in CUTS]
        # The outermost steps of a rounded end say nothing about its width.
        grip = (np.cumsum(widths)[CUTS - 1] - widths[0]) / (CUTS - 1)
        work = (widths.sum() - widths[-1] - np.cumsum(widths)[CUTS - 1]) / (STEPS - 1 - CUTS)
        chroma = np.cumsum(np.linalg.norm(colours[:, 1:], axis=1))
        greyer = chroma[CUTS - 1] / CUTS - (chroma[-1] - chroma[CUTS - 1]) / (STEPS - CUTS)
        step = np.linalg.norm(np.array(near), axis=1)
        return cls(between / max(total, 1e-6), step, np.log2(work / grip), greyer)

    def costs(self, layout: Layout) -> np.ndarray:
        """How ill each cut fits the picture and the layout."""
        cost = -2.5 * self.explained - 0.35 * np.minimum(self.step, 4.0)
        cost += 0.5 * ((CUTS / STEPS - layout.grip) / 0.13) ** 2
        cost += 0.5 * ((self.wider - np.log2(layout.width)) / 0.6) ** 2
        if layout.steel:
            cost -= 1.5 * np.clip(self.greyer / 15.0, -1.0, 1.0)
        return cost
