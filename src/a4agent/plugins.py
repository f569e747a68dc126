"""Names that packages register as entry points of one group, and names that this process adds.

    experts = Plugins("a4agent.experts", "expert provider")
    experts.find("sam2")          -> the object that the entry point "sam2" names, imported now
    experts.find("sam22")         -> UnknownNameError: unknown expert provider 'sam22'; did you mean 'sam2'?

Nothing is imported before `find` asks for it; a broken package is a warning that names it.
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from a4agent.errors import A4Error, ConfigError, UnknownNameError


class Plugins:
    """The names of one entry-point group; errors call them `kind` and end with `hint`."""

    def __init__(self, group: str, kind: str, hint: str = "") -> None:
        self.group = group
        self.kind = kind
        self.hint = hint
        self.added: dict[str, Any] = {}
        self._installed: dict[str, EntryPoint] | None = None

    @property
    def installed(self) -> Mapping[str, EntryPoint]:
        """The entry points of installed packages, by name. Read once a process."""
        if self._installed is None:
            self._installed = {}
            for point in entry_points(group=self.group):
                first = self._installed.setdefault(point.name, point)
                if first.value != point.value:
                    self._warn(f"two packages register the {self.kind} {point.name!r}; using {first.value}")
        return self._installed

    def forget(self) -> None:
        """Read the installed packages again next time."""
        self._installed = None

    def register(self, name: str, value: Any) -> None:
        """Add a name for this process, without packaging (tests, notebooks). Replaces one of the same name."""
        self.added[name] = value

    def names(self) -> list[str]:
        """All names, sorted."""
        return sorted({*self.installed, *self.added})

    def find(self, name: str) -> Any:
        """The object registered as `name`.

        Raises:
            UnknownNameError: the name is not registered; the message suggests the nearest.
            ConfigError: the name is registered, but its module cannot be imported.
        """
        if name in self.added:
            return self.added[name]
        point = self.installed.get(name)
        if point is None:
            raise UnknownNameError.of(self.kind, name, self.names(), self.hint)
        try:
            return point.load()
        except A4Error:
            raise
        except Exception as error:
            message = f"the {self.kind} {name!r} ({point.value}) cannot be imported: {error!r}"
            self._warn(message)
            raise ConfigError(message) from error

    @staticmethod
    def _warn(message: str) -> None:
        warnings.warn(message, stacklevel=3)


def keywords_of(factory: Callable[..., Any]) -> dict[str, Any] | None:
    """Names and defaults of a factory's keyword-only parameters; None if it takes any keyword."""
    parameters = inspect.signature(factory).parameters.values()
    if any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters):
        return None
    return {p.name: p.default for p in parameters if p.kind is inspect.Parameter.KEYWORD_ONLY}
