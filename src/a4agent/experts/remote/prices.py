"""What a call to a server costs, from the table in prices.toml (US dollars per million tokens).

price_of("gpt-4o-2024-08-06")                                  -> the price of "gpt-4o"
Price(input=2.5, output=10.0).cost(tokens_in=1000, tokens_out=100) -> 0.0035
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, cast

from a4agent.errors import ConfigError
from a4agent.files import read_package_toml

_SNAPSHOT = re.compile(r"-\d{4}-\d{2}-\d{2}$")


@dataclass(frozen=True)
class Price:
    """Dollars per million tokens; a special kind of token that has no price of its own costs `input`.

    `retires` is the day (ISO) from which the vendor no longer serves the model, "" if none is announced.
    """

    input: float
    output: float
    cached_input: float | None = None
    image_input: float | None = None
    as_of: str = ""
    source: str = ""
    retires: str = ""

    @property
    def is_free(self) -> bool:
        return not any((self.input, self.output, self.cached_input, self.image_input))

    def cost(self, *, tokens_in: int, tokens_out: int, cached_in: int = 0, image_in: int = 0) -> float:
        """Dollars of one call. `tokens_in` counts all input tokens, the cached and image ones included."""
        cached = self.input if self.cached_input is None else self.cached_input
        image = self.input if self.image_input is None else self.image_input
        plain_in = max(0, tokens_in - cached_in - image_in)
        return (plain_in * self.input + cached_in * cached + image_in * image + tokens_out * self.output) / 1_000_000


def price_of(model: str) -> Price | None:
    """The list price of a model or of its dated snapshot; None if the table does not have it."""
    table = read_package_toml("a4agent.experts.remote", "prices.toml")
    row = table.get(model) or table.get(_SNAPSHOT.sub("", model))
    return Price(**row) if row else None


def price_from_setting(price: Any) -> Price:
    """A price that the user states, such as {"input": 1.0, "output": 4.0}.

    Raises:
        ConfigError: an unknown key, or a price that is missing or negative.
    """
    table = dict(cast("Mapping[str, Any]", price)) if isinstance(price, Mapping) else {}
    known = {field.name for field in fields(Price)} - {"as_of", "source", "retires"}
    wrong = [key for key in table if key not in known] + [key for key in ("input", "output") if key not in table]
    if wrong or any(not isinstance(value, (int, float)) or value < 0 for value in table.values()):
        raise ConfigError(
            f"price = {price!r} is not a price: give input and output (and cached_input, image_input) "
            "in US dollars per million tokens"
        )
    stated: dict[str, Any] = {key: float(value) for key, value in table.items()}
    return Price(**stated)
