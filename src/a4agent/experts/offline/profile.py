"""An object seen along its longest axis: how wide it is and what colour it has at each step from end to end.

    profile = Profile.of(silhouette)        # 64 steps
    profile.cut(Layout(grip=0.65, width=1.9)) -> (0.34, 1.0), (0.0, 0.34): grip and working end

Most tools are a grip and a working end. Where one becomes the other is where width and colour change
most, weighed against what is known of such tools: a `Layout`. Both directions compete.
"""

from __future__ import annotations

from dataclasses import dataclass

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
        costs = [self._costs(layout, flipped) for flipped in (False, True)]
        flipped = bool(min(costs[1]) < min(costs[0]))
        share = (np.argmin(costs[flipped]) + _FIRST) / STEPS
        if flipped:
            return (1.0 - share, 1.0), (0.0, 1.0 - share)
        return (0.0, share), (share, 1.0)

    def _costs(self, layout: Layout, flipped: bool) -> np.ndarray:
        """How ill each cut, after _FIRST .. STEPS - _FIRST steps of grip, fits the picture and the layout."""
        order = slice(None, None, -1) if flipped else slice(None)
        widths, colours = np.maximum(self.widths[order], 1.0), self.colours[order]
        features = np.concatenate([1.6 * np.log2(widths)[:, None], colours / 10.0], axis=1)
        cuts = np.arange(_FIRST, STEPS - _FIRST + 1)
        total = ((features - features.mean(0)) ** 2).sum()
        left = np.array([_scatter(features[:k]) + _scatter(features[k:]) for k in cuts])
        explained = 1.0 - left / max(total, 1e-6)
        step = np.array([np.linalg.norm(features[k - 3 : k].mean(0) - features[k : k + 3].mean(0)) for k in cuts])
        ratio = np.array([np.log2(widths[k:-1].mean() / widths[1:k].mean()) for k in cuts])
        cost = -2.5 * explained - 0.35 * np.minimum(step, 4.0)
        cost += 0.5 * ((cuts / STEPS - layout.grip) / 0.13) ** 2
        cost += 0.5 * ((ratio - np.log2(layout.width)) / 0.6) ** 2
        if layout.steel:
            chroma = np.linalg.norm(colours[:, 1:], axis=1)
            greyer = np.array([chroma[:k].mean() - chroma[k:].mean() for k in cuts])
            cost -= 1.5 * np.clip(greyer / 15.0, -1.0, 1.0)
        return cost


_FIRST = 6


def _scatter(features: np.ndarray) -> float:
    return float(((features - features.mean(0)) ** 2).sum())
