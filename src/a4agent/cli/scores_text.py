"""Scores as lines for a terminal: the same wherever they are printed."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from a4agent.metrics import Scores


def lines(scores: Scores) -> list[str]:
    """The counts behind a score, then each measure with its 95 % interval, in percent."""
    from a4agent.metrics import MEASURES

    counts = (
        f"n {scores.n}  scored {scores.n_scored}  failed {scores.n_failed}  empty truth {scores.n_empty_truth}  "
        f"empty prediction {scores.n_empty_prediction}  resized {scores.n_resized}"
    )
    return [
        counts,
        *(
            f"{label:<8}{percent(getattr(scores, name))}   95% {percent(low)} to {percent(high)}"
            for name, label in MEASURES.items()
            for low, high in [scores.intervals[name]]
        ),
    ]


def percent(value: float) -> str:
    """A share of 1 in percent, "-" where it is not defined."""
    return "     -" if value != value else f"{100 * value:6.2f}"
