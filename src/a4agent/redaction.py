"""Keep secrets out of every text that leaves this process: errors, logs, manifests, rows, reports, server answers.

    Secret("sk-1234567890")                     str and repr are '***'; `reveal()` is called where a request is sent
    redact("401: bad key sk-1234567890")        -> "401: bad key ***"
    redact({"base_url": "http://me:pw@host/"})  -> {"base_url": "http://***@host/"}

Every `Secret` made in this process is remembered and replaced wherever it turns up, plain or escaped; so are the
values of environment variables whose names end in _KEY, _TOKEN, _SECRET or _PASSWORD, credentials in URLs, bearer
tokens and the keys of well-known vendors. Values of fewer than six characters are left alone: they occur in any text.
"""

from __future__ import annotations

import base64
import html
import json
import logging
import os
import re
from collections.abc import Mapping
from typing import Any, TypeVar, cast
from urllib.parse import quote, unquote

MASK = "***"
SHORTEST = 6
SECRET_NAME = re.compile(
    r"(?i)(^|[-_. ])(api[-_]?key|key|token|secret|passwd|password|authorization|auth|cookie|credentials?)$"
)
"""Names of settings, headers and environment variables whose values are secret."""
SECRET_TABLES = frozenset({"extra_headers", "headers"})
"""Tables of which every value is secret."""
_CREDENTIALS = re.compile(r"://([^/\s@]{1,500})@")
_PATTERNS = (
    (_CREDENTIALS, f"://{MASK}@"),
    (re.compile(r"(?i)\bbearer\s+[\w.~+/=-]{16,}"), f"Bearer {MASK}"),
    (
        re.compile(r"(?i)([?&](?:api[-_]?key|key|access_token|token|secret|password|sig|signature)=)[^&\s'\"<>]+"),
        rf"\1{MASK}",
    ),
    (re.compile(r"\b(?:(?:sk-|gsk_|r8_|ghp_|AIza)[\w-]{16,}|hf_[A-Za-z]{30,})"), MASK),
)
_remembered: set[str] = set()

T = TypeVar("T")


class Secret:
    """A text that messages, dumps and logs never show. Compares by its text; pickles, for worker processes."""

    __slots__ = ("_text",)

    def __init__(self, text: str) -> None:
        self._text = text
        remember(text)

    def reveal(self) -> str:
        """The text, for the request that needs it."""
        return self._text

    def __repr__(self) -> str:
        return MASK

    def __bool__(self) -> bool:
        return bool(self._text)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Secret) and other._text == self._text

    def __hash__(self) -> int:
        return hash((Secret, self._text))

    def __reduce__(self) -> tuple[type[Secret], tuple[str]]:
        return Secret, (self._text,)


def remember(text: str) -> None:
    """Replace `text` in everything that `redact` sees from now on."""
    if len(text) >= SHORTEST:
        _remembered.update(_forms(text))


def remember_url(url: str) -> None:
    """Remember the credentials of a URL, also as they are sent: http://me:pw@host gives "me:pw", "pw", "bWU6cHc="."""
    for credentials in _CREDENTIALS.findall(url):
        plain = unquote(credentials)
        for text in (credentials, plain.partition(":")[2], base64.b64encode(plain.encode()).decode()):
            remember(text)


def conceal(value: Any, name: str = "") -> Any:
    """Settings with the texts under secret names ("api_key", "extra_headers") as `Secret`s; `name` is its key."""
    if isinstance(value, Mapping):
        table = cast("Mapping[str, Any]", value)
        all_secret = name in SECRET_TABLES
        return {key: conceal(item, "secret" if all_secret else str(key)) for key, item in table.items()}
    if isinstance(value, list):
        return [conceal(item, name) for item in cast("list[Any]", value)]
    if isinstance(value, str) and value and SECRET_NAME.search(name):
        return Secret(value)
    if isinstance(value, str):
        remember_url(value)
    return value


def reveal(value: Any) -> Any:
    """The inverse of `conceal`, for the code that sends the request."""
    if isinstance(value, Secret):
        return value.reveal()
    if isinstance(value, Mapping):
        return {key: reveal(item) for key, item in cast("Mapping[str, Any]", value).items()}
    if isinstance(value, list):
        return [reveal(item) for item in cast("list[Any]", value)]
    return value


def redact(value: T) -> T:
    """`value`, a text or JSON-like data, with every known secret replaced by '***'."""
    found = _secrets()
    return cast(T, _redacted(value, re.compile("|".join(map(re.escape, found))) if found else None))


def _redacted(value: Any, known: re.Pattern[str] | None) -> Any:
    if isinstance(value, str):
        text = known.sub(MASK, value) if known else value
        for pattern, replacement in _PATTERNS:
            text = pattern.sub(replacement, text)
        return text
    if isinstance(value, Secret):
        return MASK
    if isinstance(value, Mapping):
        table = cast("Mapping[Any, Any]", value)
        return {_redacted(key, known): _redacted(item, known) for key, item in table.items()}
    if isinstance(value, (list, tuple)):
        items = [_redacted(item, known) for item in cast("list[Any]", value)]
        return items if isinstance(value, list) else tuple(items)
    return value


def _secrets() -> list[str]:
    """What to replace, the longest first: one secret may begin with another."""
    from_environment = (
        form
        for variable, text in os.environ.items()
        if len(text) >= SHORTEST and SECRET_NAME.search(variable)
        for form in _forms(text)
    )
    return sorted({*_remembered, *from_environment}, key=len, reverse=True)


def _forms(text: str) -> set[str]:
    """A text as JSON, Python source, a URL or HTML may contain it."""
    stripped = text.strip()
    return {
        text,
        stripped,
        json.dumps(stripped)[1:-1],
        repr(stripped)[1:-1],
        quote(stripped, safe=""),
        html.escape(stripped),
    }


class RedactingFilter(logging.Filter):
    """Redacts the message and the traceback of each log record."""

    def filter(self, record: logging.LogRecord) -> bool:
        record.msg, record.args = redact(record.getMessage()), None
        if record.exc_info and not record.exc_text:
            record.exc_text = redact(logging.Formatter().formatException(record.exc_info))
        return True


logging.getLogger("a4agent").addFilter(RedactingFilter())
