"""From scored runs to a calibration: how likely is a mask right, given what the Verifier measured?

calibration = fit([read_run("runs/folder-offline-1f0c3a9e")], kind="logistic")
calibration.card["auroc"]                                            # cross-validated, no image on both sides

The features are the values of the records' checks; an answer is right if its IoU is at least 0.5. For the file and its
use see `stages.calibration`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from typing import Any, Literal

import numpy as np

from a4agent.errors import DataError, require
from a4agent.runs import trust
from a4agent.runs.store import Record, Run
from a4agent.stages.calibration import Calibration

Kind = Literal["logistic", "isotonic"]
FOLDS = 5
LEAST = 20


@dataclass(frozen=True)
class _Fitted:
    """`values` (n, features), NaN where one was not measured; `right` (n,) bool; `images` (n,) ids of pictures."""

    features: tuple[str, ...]
    values: np.ndarray
    right: np.ndarray
    images: np.ndarray


def fit(runs: Sequence[Run], kind: Kind = "logistic", *, seed: int = 0) -> Calibration:
    """The calibration of the answers in `runs`, with cross-validated AUROC, ECE and Brier score in its card.

    No image is on both sides of a fold. Isotonic regression bends the logistic score and needs a few hundred answers.

    Raises:
        DataError: there are too few answers with checks, all of them are right or all wrong, or a run has an oracle.
        MissingExtraError: scikit-learn is not installed.
    """
    data = _gathered(runs)
    folds = _folds(data, seed)
    held_out = np.zeros(len(data.right))
    for chosen in range(int(folds.max()) + 1):
        train, test = folds != chosen, folds == chosen
        part = _fit(data, train, kind)
        held_out[test] = [part.probability(_named(data, i)) for i in np.flatnonzero(test).tolist()]
    right = data.right
    card = {
        "protocol": "IoU >= 0.5",
        "data": sorted({str(run.manifest.identity["benchmark"]) for run in runs}),
        "runs": [{"run": run.manifest.hash, "label": run.manifest.label} for run in runs],
        "n": len(right),
        "right": int(right.sum()),
        "images": len(np.unique(data.images)),
        "folds": int(folds.max()) + 1,
        "auroc": round(trust.auroc(held_out, right), 4),
        "ece": round(trust.ece(held_out, right), 4),
        "brier": round(float(np.square(held_out - right).mean()), 4),
        "created": datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }
    return replace(_fit(data, np.ones(len(right), bool), kind), card=card)


def _gathered(runs: Sequence[Run]) -> _Fitted:
    records: list[tuple[Run, Record]] = []
    for run in runs:
        if run.manifest.identity.get("oracle"):
            raise DataError(f"{str(run.folder)!r} was made with an oracle: its answers have seen the truth; remove it")
        records += [(run, record) for record in run.records.values() if record.row.get("checks")]
    measured: list[dict[str, float]] = [
        {check["name"]: check["value"] for check in record.row["checks"] if check["value"] is not None}
        for _, record in records
    ]
    features = tuple(sorted({name for values in measured for name in values}))
    if len(records) < LEAST or not features:
        raise DataError(
            f"a calibration needs at least {LEAST} answers with checks, and these runs have {len(records)};"
            " run `a4 bench` with a profile that has a [verifier]"
        )
    right = np.array([record.iou >= 0.5 for _, record in records])
    if right.all() or not right.any():
        raise DataError(
            f"all {len(right)} answers are {'right' if right.all() else 'wrong'} (IoU >= 0.5):"
            " a calibration needs answers of both kinds"
        )
    values = np.array([[found.get(name, np.nan) for name in features] for found in measured])
    images = np.array([record.pictures.get("original") or f"{run.folder} {record.id}" for run, record in records])
    return _Fitted(features, values, right, images)


def _folds(data: _Fitted, seed: int) -> np.ndarray:
    """The fold (n,) of each answer: whole images, with right and wrong answers in each."""
    require("sklearn", extra="bench")
    from sklearn.model_selection import StratifiedGroupKFold

    count = min(FOLDS, len(np.unique(data.images)), int(data.right.sum()), int((~data.right).sum()))
    if count < 2:
        raise DataError("a calibration needs right and wrong answers on at least two images each, to hold some out")
    splitter: Any = StratifiedGroupKFold(count, shuffle=True, random_state=seed)
    folds = np.zeros(len(data.right), int)
    for number, (_, test) in enumerate(splitter.split(data.values, data.right, data.images)):
        folds[test] = number
    return folds


def _fit(data: _Fitted, chosen: np.ndarray, kind: Kind) -> Calibration:
    """A calibration of the `chosen` (n,) answers. A missing value is filled with the median of its feature."""
    from sklearn.isotonic import IsotonicRegression
    from sklearn.linear_model import LogisticRegression

    values, right = data.values[chosen], data.right[chosen]
    known = [column[~np.isnan(column)] for column in values.T]
    fill = np.array([np.median(column) if len(column) else 0.5 for column in known])
    values = np.where(np.isnan(values), fill, values)
    if right.all() or not right.any():  # a small fold
        raise DataError("a calibration needs more answers of both kinds: in one fold all are right, or all wrong")
    model: Any = LogisticRegression(C=10.0, max_iter=1000).fit(values, right)
    found = Calibration(
        kind="logistic",
        features=data.features,
        coefficients=tuple(np.round(model.coef_[0], 6).tolist()),
        fill=tuple(np.round(fill, 6).tolist()),
        intercept=round(float(model.intercept_[0]), 6),
    )
    if kind == "logistic":
        return found
    scores = [found.score(dict(zip(data.features, row, strict=True))) for row in values.tolist()]
    curve: Any = IsotonicRegression(out_of_bounds="clip").fit(scores, right)
    knots = zip(curve.X_thresholds_.tolist(), curve.y_thresholds_.tolist(), strict=True)
    return replace(found, kind="isotonic", knots=tuple((round(x, 6), min(1.0, round(y, 6))) for x, y in knots))


def _named(data: _Fitted, i: int) -> dict[str, float | None]:
    row = data.values[i].tolist()
    return {name: None if value != value else value for name, value in zip(data.features, row, strict=True)}
