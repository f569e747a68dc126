"""A connection to an OpenAI-compatible server: its address, its key, and what its failures mean.

    connection = Connection("gpt-4o", base_url="", server="", api_key_variable="", timeout=120, max_retries=2)
    completion, sent = connection.call(lambda client: client.chat.completions.with_raw_response.create(...))

What differs between servers is data (servers.toml). Retries with Retry-After are the SDK's. Every failure
comes out as an error of `a4agent.errors` that names the server, the model and what to change.
"""

from __future__ import annotations

import copy
import email.utils
import json
import math
import os
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from a4agent.errors import (
    A4Error,
    ConfigError,
    CredentialError,
    ProviderTimeout,
    ProviderUnavailable,
    RateLimited,
    RefusedAnswer,
    RequestRejected,
    UnknownNameError,
    require,
)
from a4agent.files import read_package_toml
from a4agent.redaction import Secret, remember_url

_NO_QUOTA = ("insufficient_quota", "billing_hard_limit_reached", "billing_not_active")
_DECLINED = ("content_filter", "content_policy", "moderation_blocked", "responsibleaipolicy", "safety system")
_NOT_JSON = (json.JSONDecodeError, UnicodeDecodeError, RecursionError)
_LOCAL_KEY = Secret("none")  # the SDK wants some key; servers without one ignore it


@dataclass(frozen=True)
class Server:
    """One row of servers.toml; the fields are explained there."""

    name: str
    hosts: list[str]
    ports: list[int]
    base_url: str
    key_variable: str
    key_required: bool
    structured: list[str]
    schema_shape: str
    max_tokens_field: str
    reasoning_fields: list[str]
    edit_seed: bool
    priced: bool


@dataclass(frozen=True)
class Sent:
    """What is known of a call besides its answer."""

    seconds: float
    attempts: int
    request_id: str


def servers() -> dict[str, Server]:
    """The known servers, by name."""
    table = read_package_toml("a4agent.experts.remote", "servers.toml")
    return {name: Server(name=name, **row) for name, row in table.items()}


def find_server(name: str = "", base_url: str = "") -> Server:
    """The server called `name`, else the one `base_url` points to by host or port, else "other".

    Raises:
        UnknownNameError: no server of that name.
        ConfigError: `base_url` is not a URL.
    """
    known = servers()
    if name:
        if name not in known:
            raise UnknownNameError.of("server", name, known)
        return known[name]
    if not base_url:
        return known["openai"]
    host, port = _host_and_port(base_url)
    by_host = (server for server in known.values() if host in server.hosts)
    by_port = (server for server in known.values() if port is not None and port in server.ports)
    return next(by_host, None) or next(by_port, None) or known["other"]


def _host_and_port(base_url: str) -> tuple[str, int | None]:
    try:
        address = urlsplit(base_url)
        if address.scheme in ("http", "https") and address.hostname:
            return address.hostname, address.port
    except ValueError:  # an invalid port
        pass
    raise ConfigError(f"base_url = {base_url!r} is not a URL; use 'http://127.0.0.1:8000/v1'")


class Connection:
    """One model on one server. Safe for several threads at once; connects on the first call.

    Args as in `RemoteExpert`, and:
        server: "" recognises it by `base_url`.
        api_key_variable: a vendor's key goes to no other address, unless it is named here or the vendor as `server`.

    Raises:
        CredentialError: the server needs a key and the variable is not set.
        ConfigError: `base_url` is missing or not a URL, or OPENAI_BASE_URL names another one.
    """

    def __init__(
        self, model: str, base_url: str, server: str, api_key_variable: str, timeout: float, max_retries: int
    ) -> None:
        if not model:
            raise ConfigError("a model's name is missing after the colon, as in 'openai:gpt-4o'")
        if timeout <= 0 or max_retries < 0:
            raise ConfigError(f"timeout is above 0 and max_retries 0 or more, not {timeout!r} and {max_retries!r}")
        self.model = model
        self.server = find_server(server, base_url)
        self.base_url = (base_url or self.server.base_url).rstrip("/")
        _host_and_port(self.base_url)
        if not base_url and self.server.name == "openai":
            self._refuse_another_place(os.environ.get("OPENAI_BASE_URL", "").strip().rstrip("/"))
        remember_url(self.base_url)
        self._key_variable = api_key_variable or self.server.key_variable
        self._key = self._read_key(required=bool(api_key_variable) or self.server.key_required)
        self._timeout = timeout
        self._max_retries = max_retries
        self._openai = require("openai", extra="api")
        self._client: Any = None
        self._lock = threading.Lock()

    def call(self, send: Callable[[Any], Any]) -> tuple[Any, Sent]:
        """Let `send(client)` make one `with_raw_response` call; return what it parsed and how it went.

        Raises:
            A4Error: the call failed; the class tells who must act and whether a retry may help.
        """
        start = time.perf_counter()
        try:
            raw = send(self._connected().with_options(max_retries=self._max_retries))
            parsed = raw.parse()
        except (self._openai.OpenAIError, *_NOT_JSON) as error:
            raise self._explain(error) from error
        if parsed is None or isinstance(parsed, str):
            raise ProviderUnavailable(f"{self} sent something that is not an answer: {str(parsed)[:200]!r}")
        seconds = time.perf_counter() - start
        request_id = raw.headers.get("x-request-id") or str(getattr(parsed, "id", "") or "")
        return parsed, Sent(seconds, int(getattr(raw, "retries_taken", 0)) + 1, request_id)

    def models(self) -> list[str]:
        """The model names that the server lists; [] if it lists none."""
        try:
            listed = self._connected().with_options(max_retries=0, timeout=5.0).models.list()
            return [model.id for model in listed.data]
        except (self._openai.OpenAIError, *_NOT_JSON, AttributeError, TypeError):
            return []

    def shutdown_date(self) -> str:
        """The day that the server announces as this model's last, as it writes it; "" if it announces none.

        Never raises: a server that does not answer announces nothing.
        """
        try:
            model = self._connected().with_options(max_retries=0, timeout=5.0).models.retrieve(self.model)
            return str(getattr(model, "shutdown_date", None) or "")
        except (self._openai.OpenAIError, *_NOT_JSON, AttributeError, TypeError):
            return ""

    def without_retries(self) -> Connection:
        """The same connection, whose calls are made once; it ends when this one is closed."""
        self._connected()
        twin = copy.copy(self)
        twin._max_retries = 0
        return twin

    def close(self) -> None:
        with self._lock:
            client, self._client = self._client, None
        if client is not None:
            client.close()

    def __str__(self) -> str:
        return f"{self.model!r} at {self.base_url}"

    def _connected(self) -> Any:
        with self._lock:
            if self._client is None:
                self._client = self._openai.OpenAI(
                    api_key=self._key.reveal(),
                    base_url=self.base_url,
                    timeout=self._timeout,
                )
            return self._client

    def _refuse_another_place(self, wanted: str) -> None:
        """Keep pictures from going to OpenAI when the user expects another server.

        The variable is not followed, because where answers come from is part of a run's settings.
        """
        if wanted and wanted != self.base_url:
            remember_url(wanted)
            raise ConfigError(
                f"OPENAI_BASE_URL is {wanted!r}, but {self} goes by its settings: name the server with the expert's"
                f" setting base_url = {wanted!r} (and the variable with its key with api_key_variable), or unset"
                " OPENAI_BASE_URL"
            )

    def _read_key(self, *, required: bool) -> Secret:
        name = self._key_variable
        key = os.environ.get(name, "").strip() if name else ""
        if required and not key:
            raise CredentialError(
                f"{self} needs a key, and the environment variable {name} is not set: export {name}=..."
            )
        return Secret(key) if key else _LOCAL_KEY

    def _explain(self, error: Exception) -> A4Error:
        sdk = self._openai
        if isinstance(error, sdk.APITimeoutError):
            return ProviderTimeout(
                f"{self} gave no answer within {self._timeout:g} s (tried {self._max_retries + 1} times); "
                "raise the setting `timeout`, or send fewer requests at once with `concurrency`"
            )
        if isinstance(error, sdk.APIStatusError):
            return self._explain_status(error)
        if isinstance(error, sdk.APIConnectionError):
            reason = error.__cause__ or error
            return ProviderUnavailable(f"cannot reach {self}: {reason}; is the server running, and is base_url right?")
        return ProviderUnavailable(f"{self} sent something that is not an answer: {error}")

    def _explain_status(self, error: Any) -> A4Error:
        status, said = int(error.status_code), _message_of(error)
        about = f"{self} answered {status}: {said}"
        low = f"{error.code or ''} {error.type or ''} {said}".lower()
        retry_after = _retry_after(error.response.headers)
        if any(mark in low for mark in _NO_QUOTA):
            return CredentialError(f"{about}; the account has no credit left: add some, or use another key")
        if status in (401, 403):
            if self._key is _LOCAL_KEY:
                named = f"set {self._key_variable}, or " if self._key_variable else ""
                return CredentialError(
                    f"{about}; no key was sent to this address: {named}name the variable that holds its key with the"
                    " expert's setting api_key_variable"
                )
            return CredentialError(f"{about}; check the key in {self._key_variable}")
        if status == 404:
            return self._explain_not_found(about, low)
        if status == 429 or (status in (503, 529) and retry_after is not None):
            return RateLimited(f"{about}; lower the setting `concurrency`", retry_after)
        if status == 408:
            return ProviderTimeout(about)
        if status >= 500 or status == 409:
            return ProviderUnavailable(about)
        if any(mark in low for mark in _DECLINED):
            return RefusedAnswer(about)
        return RequestRejected(about)

    def _explain_not_found(self, about: str, low: str) -> A4Error:
        known = self.models()
        if known and self.model not in known:
            return UnknownNameError.of(f"model at {self.base_url}:", self.model, known)
        if "model" in low:
            return UnknownNameError(f"{about}; check the name after 'openai:'")
        return ConfigError(f"{about}; base_url usually ends in '/v1'")


def _message_of(error: Any) -> str:
    """The server's message, shortened."""
    body = error.body
    if isinstance(body, Mapping):
        body = body.get("message") or body.get("detail") or body.get("error") or body
    text = str(body or error.message)
    return text if len(text) <= 400 else text[:400] + " ..."


def _retry_after(headers: Mapping[str, str]) -> float | None:
    """Seconds from Retry-After (a number or an HTTP date) or its variant in milliseconds; None if there is none."""
    value = headers.get("retry-after", "")
    for number, unit in ((headers.get("retry-after-ms", ""), 0.001), (value, 1.0)):
        try:
            seconds = float(number) * unit
        except ValueError:
            continue
        return max(0.0, seconds) if math.isfinite(seconds) else None
    date = email.utils.parsedate_tz(value)
    try:
        return None if date is None else max(0.0, email.utils.mktime_tz((*date[:9], date[9] or 0)) - time.time())
    except (ValueError, OverflowError):
        return None
