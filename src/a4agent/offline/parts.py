"""An object's parts by their shape: one short rule for each word of `phrases.SHAPES`.

    Anatomy(silhouette).find(Wanted("loop", layout)) -> (h, w) bool

A rule that finds nothing hands over to the next best (a mug without a visible loop: what sticks out of it;
then the whole object), so that there is always an answer.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from a4agent.errors import require
from a4agent.offline import details
from a4agent.offline.boxes import depth_in
from a4agent.offline.phrases import Wanted
from a4agent.offline.profile import Layout, Profile, Span
from a4agent.offline.protrusions import Piece, split
from a4agent.offline.silhouette import Silhouette

ELONGATED = 2.0
"""From this ratio of length to width on, an object is taken apart along its axis."""
TIP = 0.16
"""A tip's share of the object's length."""


class Anatomy:
    """The parts of one silhouette, worked out as they are asked for."""

    def __init__(self, silhouette: Silhouette) -> None:
        self.mask, self.lab = silhouette.mask, silhouette.lab
        self._cuts: dict[Layout, tuple[Span, Span]] = {}

    def find(self, wanted: Wanted) -> np.ndarray:
        """The region (h, w) bool, never blank."""
        found = getattr(self, f"_{wanted.shape}")(wanted.layout)
        return found if found is not None and found.any() else self.mask

    @cached_property
    def profile(self) -> Profile:
        return Profile.of(self.mask, self.lab)

    @cached_property
    def _split(self) -> tuple[np.ndarray, list[Piece]]:
        return split(self.mask)

    @cached_property
    def _details(self) -> list[details.Detail]:
        return list(details.details(self.mask, self.lab))

    def _cut(self, layout: Layout) -> tuple[Span, Span]:
        if layout not in self._cuts:
            self._cuts[layout] = self.profile.cut(layout)
        return self._cuts[layout]

    def _whole(self, layout: Layout) -> np.ndarray:
        return self.mask

    def _grip(self, layout: Layout) -> np.ndarray:
        return self.profile.between(*self._cut(layout)[0])

    def _work(self, layout: Layout) -> np.ndarray:
        return self.profile.between(*self._cut(layout)[1])

    def _tip(self, layout: Layout) -> np.ndarray:
        """The far end of the working end."""
        start, end = self._cut(layout)[1]
        size = min(TIP, 0.6 * (end - start))
        return self.profile.between(start, start + size) if start == 0.0 else self.profile.between(end - size, end)

    def _loop(self, layout: Layout) -> np.ndarray | None:
        """What sticks out and encloses a hole; then what sticks out; then the grip of something long."""
        pieces = self._split[1]
        loops = [piece for piece in pieces if piece.hole] or pieces
        if loops:
            return max(loops, key=lambda piece: piece.area + piece.hole).mask
        return self._grip(layout) if self.profile.elongation > ELONGATED else None

    def _arm(self, layout: Layout) -> np.ndarray | None:
        """The largest thing that sticks out."""
        pieces = self._split[1]
        if pieces:
            return pieces[0].mask
        return self._grip(layout) if self.profile.elongation > ELONGATED else None

    def _spout(self, layout: Layout) -> np.ndarray | None:
        """What sticks out and is no loop."""
        pieces = self._split[1]
        loop = max(pieces, key=lambda piece: piece.area + 3 * piece.hole, default=None)
        others = [piece for piece in pieces if piece is not loop and not piece.hole]
        return others[0].mask if others else self._top(layout)

    def _body(self, layout: Layout) -> np.ndarray:
        return self._split[0]

    def _handle(self, layout: Layout) -> np.ndarray | None:
        """Whatever looks like a handle, of an object that is not known."""
        pieces = self._split[1]
        large = [piece for piece in pieces if piece.area > 0.05 * self.mask.sum()]
        if any(piece.hole for piece in large):
            return self._loop(layout)
        if self.profile.elongation > ELONGATED:
            return self._grip(layout)
        return large[0].mask if large else self._bar(layout)

    def _opening(self, layout: Layout) -> np.ndarray:
        """The inside of a vessel: an ellipse of another colour, else the one that the top of its outline implies."""
        seen = details.widest_ellipse(self._details, self.mask)
        return self._implied_opening() if seen is None else seen

    def _implied_opening(self) -> np.ndarray:
        """The ellipse whose far half is the top of the outline, as of a vessel seen from above."""
        cv2 = require("cv2", extra="offline")
        body = self._split[0]
        rows = np.flatnonzero(body.any(1))
        widths = body[rows].sum(1)
        widest = int(np.argmax(widths >= 0.95 * widths[: max(1, int(0.7 * len(rows)))].max()))
        columns = np.flatnonzero(body[rows[widest]])
        centre = round((columns[0] + columns[-1]) / 2), int(rows[widest])
        axes = max(1, int(0.95 * len(columns) / 2)), max(1, int(0.95 * (widest + 1)))
        ellipse = cv2.ellipse(np.zeros(body.shape, np.uint8), centre, axes, 0, 0, 360, 1, -1)
        return (ellipse > 0) & self.mask

    def _rim(self, layout: Layout) -> np.ndarray:
        """The border of the opening."""
        depth = depth_in(self._opening(layout))
        return (depth > 0) & (depth <= max(2.0, 0.25 * depth.max()))

    def _upright(self, start: float, end: float) -> np.ndarray:
        """The slice of the object from `start` to `end` of its height in the picture."""
        rows = np.flatnonzero(self.mask.any(1))
        band = np.zeros_like(self.mask)
        first, count = rows[0], rows[-1] + 1 - rows[0]
        band[first + int(start * count) : first + max(int(np.ceil(end * count)), int(start * count) + 1)] = True
        return self.mask & band

    def _top(self, layout: Layout) -> np.ndarray:
        return self._work(layout) if self._lies() else self._upright(0.0, 0.28)

    def _lower(self, layout: Layout) -> np.ndarray:
        return self._grip(layout) if self._lies() else self._upright(0.28, 1.0)

    def _middle(self, layout: Layout) -> np.ndarray:
        return self.profile.between(0.33, 0.67) if self._lies() else self._upright(0.33, 0.67)

    def _bottom(self, layout: Layout) -> np.ndarray:
        return self._upright(0.82, 1.0)

    def _lies(self) -> bool:
        """Whether this is something long that lies in the picture rather than stands in it."""
        rows, columns = self.mask.any(1).sum(), self.mask.any(0).sum()
        return self.profile.elongation > ELONGATED and columns > 0.7 * rows

    def _bar(self, layout: Layout) -> np.ndarray | None:
        """A long thin thing on something larger: a drawer's or refrigerator's handle."""
        if details.slimness(self.mask) > details.BAR:  # it is what stood out, as before a plain door
            return self.mask
        return details.longest(self._details)

    def _spot(self, layout: Layout) -> np.ndarray | None:
        """A small compact thing on something larger: a button, a knob."""
        return details.most_compact(self._details)
