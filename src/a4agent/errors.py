"""All errors raised on purpose, grouped by who must act.

    A4Error
    ├── UserError                 the caller can fix it; the message ends with how
    │   ├── InputError            an unusable image or instruction
    │   ├── ConfigError           an invalid setting, profile or settings file
    │   ├── UnknownNameError      an unregistered provider, profile or benchmark (suggests the nearest)
    │   ├── MissingExtraError     a library that an optional feature needs is not installed
    │   ├── CredentialError       a key is missing or refused
    │   ├── ModelFilesError       a checkpoint is missing, incomplete or damaged
    │   ├── DataError             an unreadable dataset, predictions or run folder
    │   └── ResourceError         this machine lacks memory, file handles or a renderer
    ├── AnswerError               a model gave an unusable answer
    │   ├── UnreadableAnswer      not in the requested form
    │   ├── TruncatedAnswer       cut off by the token limit
    │   └── RefusedAnswer         the model or its guard declined
    ├── ProviderError             the model could not be asked
    │   ├── RateLimited           too many requests; `retry_after` seconds if given
    │   ├── ProviderTimeout       no answer in time
    │   ├── ProviderUnavailable   5xx, a refused or broken connection
    │   ├── OutOfMemory           the batch was too large; a smaller one may fit
    │   └── RequestRejected       the provider refuses this request for good
    └── BudgetExceeded            a limit of money or time is reached

Each class says whether the same call may succeed later (`retryable`) and whether every other
sample would fail the same way (`fatal`: the engine stops the run at the first one).
"""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Iterable
from types import ModuleType
from typing import Any

from a4agent.redaction import redact


class A4Error(Exception):
    """Base of all errors raised on purpose by a4agent. Secrets in the message are replaced by '***'."""

    retryable = False
    fatal = False
    usage: Any = None
    """The `Usage` of an answer that was paid for and cannot be used, if the expert knows it."""

    def __init__(self, *args: object) -> None:
        super().__init__(*(redact(arg) for arg in args))


class UserError(A4Error):
    """Something the caller can fix."""


class InputError(UserError):
    """An image or instruction that cannot be used."""


class ConfigError(UserError):
    """An invalid setting."""

    fatal = True


class UnknownNameError(ConfigError):
    """A name that is not registered."""

    @classmethod
    def of(cls, kind: str, name: str, known: Iterable[str], hint: str = "") -> UnknownNameError:
        """Build the message "unknown KIND 'NAME'; did you mean ...?" from the known names."""
        names = sorted(known)
        near = nearest(name, names)
        guess = f"; did you mean {near!r}?" if near else f"; known: {', '.join(names) or 'none'}."
        return cls(f"unknown {kind} {name!r}{guess}{' ' + hint if hint else ''}")


class MissingExtraError(UserError):
    """A library of an optional extra is not installed."""

    fatal = True


class CredentialError(UserError):
    """A key is missing or refused."""

    fatal = True


class ModelFilesError(UserError):
    """A checkpoint that cannot be loaded."""

    fatal = True


class DataError(UserError):
    """A dataset, predictions folder or run folder that cannot be read."""


class ResourceError(UserError):
    """This machine lacks what the work needs: memory, file handles, a renderer."""

    fatal = True


class AnswerError(A4Error):
    """A model answered, but the answer cannot be used."""


class UnreadableAnswer(AnswerError):
    """The answer is not in the requested form."""


class TruncatedAnswer(AnswerError):
    """The answer was cut off by the token limit."""


class RefusedAnswer(AnswerError):
    """The model, or a guard in front of it, declined."""


class ProviderError(A4Error):
    """A model could not be asked."""


class RateLimited(ProviderError):
    """The provider asks to slow down. `retry_after` is in seconds, None if not given."""

    retryable = True

    def __init__(self, message: str, retry_after: float | None = None) -> None:
        super().__init__(message)
        self.retry_after = retry_after


class ProviderTimeout(ProviderError):
    """No answer came in time."""

    retryable = True


class ProviderUnavailable(ProviderError):
    """The provider failed or could not be reached."""

    retryable = True


class OutOfMemory(ProviderError):
    """The accelerator or machine ran out of memory on this batch; the same one would again."""


class RequestRejected(ProviderError):
    """The provider refuses this request for good."""


class BudgetExceeded(A4Error):
    """A budget of money or time is used up."""


def first_problem(error: Any, whole: str) -> str:
    """The first problem of a pydantic `ValidationError` as "spotter.pairing: ..."; `whole` names the value itself."""
    first = error.errors(include_url=False, include_input=False)[0]
    return f"{'.'.join(map(str, first['loc'])) or whole}: {first['msg']}"


def nearest(name: str, known: Iterable[str]) -> str | None:
    """The known name most similar to `name`, or None."""
    found = difflib.get_close_matches(name, list(known), n=1, cutoff=0.55)
    return found[0] if found else None


def require(module: str, extra: str) -> ModuleType:
    """Import `module`, or say which extra brings it.

    Raises:
        MissingExtraError: the module is not installed; the message holds the pip command.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        top = module.partition(".")[0]
        if error.name is None or error.name.partition(".")[0] != top:
            raise
        raise MissingExtraError(
            f"{top!r} is not installed; it comes with the extra {extra!r}: pip install 'a4agent[{extra}]'"
        ) from error
