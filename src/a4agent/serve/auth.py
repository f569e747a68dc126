"""Who may call: on loopback anyone at this machine, beyond it only who holds the token."""

from __future__ import annotations

import hmac
import ipaddress
import os
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import urlsplit

from a4agent.errors import ConfigError
from a4agent.serve.limits import Refused

VARIABLE = "A4_SERVER_TOKEN"
SHORTEST = 16
MAKE_TOKEN = "python -c 'import secrets; print(secrets.token_urlsafe())'"
OPEN_PATHS = frozenset({"/healthz", "/readyz", "/openapi.json"})
"""What probes and code generators may read without a token; nothing here tells about requests."""


def is_loopback(host: str) -> bool:
    """Whether a host name or address can only be reached from this machine."""
    name = host.strip("[]").lower()
    if name == "localhost":
        return True
    try:
        return ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False


def read_token(host: str, token_file: Path | None = None, environ: Mapping[str, str] | None = None) -> str | None:
    """The token from a file or from A4_SERVER_TOKEN; None only where `host` is loopback.

    Raises:
        ConfigError: no token for a host that others can reach, an unreadable file, or a token that is too short.
    """
    if token_file is not None:
        try:
            token = token_file.read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"the token file {str(token_file)!r} cannot be read: {error}") from error
        source = repr(str(token_file))
    else:
        token = (os.environ if environ is None else environ).get(VARIABLE, "").strip()
        source = VARIABLE
    if not token:
        if token_file is not None:
            raise ConfigError(f"the token file {str(token_file)!r} is empty: {MAKE_TOKEN} > {str(token_file)!r}")
        if is_loopback(host):
            return None
        raise ConfigError(
            f"serving on {host!r} needs a token, because others can reach it: set {VARIABLE} or --token-file"
            f" ({MAKE_TOKEN} makes one), or serve on 127.0.0.1"
        )
    if len(token) < SHORTEST or not token.isascii() or not token.isprintable() or " " in token:
        raise ConfigError(f"the token in {source} must be {SHORTEST} or more printable ASCII characters without spaces")
    return token


def check(token: str | None, path: str, headers: Mapping[str, str]) -> None:
    """Let a request in or not.

    Without a token, the `Host` and `Origin` must be loopback too: a page that the user of this machine has open
    must not be able to call the server through the browser.

    Raises:
        Refused: 401 without the token, 403 from a foreign web page.
    """
    if path in OPEN_PATHS:
        return
    if token is None:
        origin = headers.get("origin")
        from_elsewhere = origin is not None and not is_loopback(_host_of(origin))
        if not is_loopback(_host_of(f"//{headers.get('host', '')}")) or from_elsewhere:
            raise Refused(403, "this server answers only requests made to and from this machine")
        return
    kind, _, given = headers.get("authorization", "").partition(" ")
    if kind.lower() != "bearer" or not hmac.compare_digest(given.strip().encode(), token.encode()):
        raise Refused(401, "this server needs its token: send the header 'Authorization: Bearer TOKEN'")


def _host_of(url: str) -> str:
    """The host that a URL names; "" for one that cannot be read."""
    try:
        return urlsplit(url).hostname or ""
    except ValueError:
        return ""
