"""From what the Verifier measured to a probability that the mask is right; fitted by `a4 calibrate`.

    {"schema": 1, "kind": "logistic", "features": ["point_in_mask", "mirror"], "coefficients": [2.1, 4.0],
     "intercept": -3.2, "fill": [0.97, 0.81], "protocol": "strict", "data": "umd", "n": 1180, "auroc": 0.91, ...}

    score = intercept + sum(coefficient * value)          a check without a value counts as `fill`
    logistic:  p = 1 / (1 + exp(-score))
    isotonic:  p = the line through "knots" [[score, p], ...] at the score, level beyond its ends

Other fields say what the file was fitted on. Scikit-learn is needed to fit one, not to use it.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, cast

from a4agent.errors import ConfigError
from a4agent.types import Check

CALIBRATIONS = Path(__file__).parents[1] / "profiles" / "calibrations"
SCHEMA = 1
READ = ("schema", "kind", "features", "coefficients", "intercept", "fill", "knots")


@dataclass(frozen=True)
class Calibration:
    """The numbers of a calibration file; `card` holds its other fields, `sha256` names the file's content."""

    kind: Literal["logistic", "isotonic"]
    features: tuple[str, ...]
    coefficients: tuple[float, ...]
    fill: tuple[float, ...]
    intercept: float = 0.0
    knots: tuple[tuple[float, float], ...] = ()
    card: Mapping[str, Any] = field(default_factory=dict, compare=False)
    sha256: str = field(default="", compare=False)

    def score(self, values: Mapping[str, float | None]) -> float:
        """The weighted sum of the values; one that is missing or None counts as its `fill`."""
        total = self.intercept
        for name, coefficient, fill in zip(self.features, self.coefficients, self.fill, strict=True):
            value = values.get(name)
            total += coefficient * (fill if value is None else value)
        return total

    def probability(self, values: Mapping[str, float | None]) -> float:
        """How likely it is that the mask is right (0 to 1), given the checks' values by name."""
        score = self.score(values)
        return _logistic(score) if self.kind == "logistic" else _interpolated(score, self.knots)

    def to_dict(self) -> dict[str, Any]:
        """The content of a calibration file."""
        knots = {"knots": [list(knot) for knot in self.knots]} if self.kind == "isotonic" else {}
        return {
            "schema": SCHEMA,
            "kind": self.kind,
            "features": list(self.features),
            "coefficients": list(self.coefficients),
            "intercept": self.intercept,
            "fill": list(self.fill),
            **knots,
            **self.card,
        }


def values_of(checks: Sequence[Check]) -> dict[str, float | None]:
    """The checks' values by name."""
    return {check.name: check.value for check in checks}


def load_calibration(source: str | Path) -> Calibration:
    """The calibration in a file, or the one that ships under a name ("offline").

    Raises:
        ConfigError: there is no such file, or it is not a calibration.
    """
    shipped = CALIBRATIONS / f"{source}.json"
    path = shipped if str(source).isidentifier() and shipped.is_file() else Path(source)
    try:
        raw = path.read_bytes()
    except OSError as error:
        names = ", ".join(sorted(file.stem for file in CALIBRATIONS.glob("*.json"))) or "none"
        raise ConfigError(
            f"cannot read the calibration {str(source)!r}: {error.strerror}; `a4 calibrate RUN --out FILE` writes one"
            f" (shipped: {names})"
        ) from error
    try:
        return read_calibration(json.loads(raw), hashlib.sha256(raw).hexdigest())
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise ConfigError(
            f"{str(source)!r} is not a calibration: {error}; write one with `a4 calibrate RUN --out FILE`"
        ) from error


def read_calibration(data: Mapping[str, Any], sha256: str = "") -> Calibration:
    """The calibration that `Calibration.to_dict` wrote.

    Raises:
        ValueError: a field is missing or has an unusable value.
    """
    if not isinstance(cast(Any, data), Mapping) or data.get("schema") != SCHEMA:
        raise ValueError(f"schema {SCHEMA} is expected")
    if data.get("kind") not in ("logistic", "isotonic"):
        raise ValueError(f"kind is 'logistic' or 'isotonic', not {data.get('kind')!r}")
    features = data.get("features")
    if not isinstance(features, list) or not all(isinstance(name, str) for name in features):
        raise ValueError("features must be a list of names of checks")
    knots = data.get("knots", [])
    if data["kind"] == "isotonic" and not knots:
        raise ValueError("an isotonic calibration needs knots")
    found = Calibration(
        kind=data["kind"],
        features=tuple(features),
        coefficients=_numbers(data, "coefficients", len(features)),
        fill=_numbers(data, "fill", len(features)),
        intercept=_number(data.get("intercept", 0.0), "intercept"),
        knots=tuple((_number(x, "knots"), _number(y, "knots")) for x, y in knots),
        card={name: value for name, value in data.items() if name not in READ},
        sha256=sha256,
    )
    if any(a[0] > b[0] or a[1] > b[1] for a, b in pairwise(found.knots)):
        raise ValueError("knots must rise from left to right")
    if any(not 0 <= probability <= 1 for _, probability in found.knots):
        raise ValueError("knots hold probabilities from 0 to 1")
    return found


def _numbers(data: Mapping[str, Any], name: str, count: int) -> tuple[float, ...]:
    values = data.get(name)
    if not isinstance(values, list) or len(values) != count:
        raise ValueError(f"{name} must be a list of {count} numbers, one for each feature")
    return tuple(_number(value, name) for value in values)


def _number(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f"{name} must hold finite numbers, not {value!r}")
    return float(value)


def _logistic(score: float) -> float:
    if score >= 0:
        return 1 / (1 + math.exp(-score))
    return (e := math.exp(score)) / (1 + e)


def _interpolated(score: float, knots: Sequence[tuple[float, float]]) -> float:
    if score <= knots[0][0]:
        return knots[0][1]
    for (x0, y0), (x1, y1) in pairwise(knots):
        if score <= x1:
            return y1 if x1 == x0 else y0 + (y1 - y0) * (score - x0) / (x1 - x0)
    return knots[-1][1]
