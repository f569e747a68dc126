"""The profiles behind the page, and the models of the one that was asked for last: loaded once, kept until then."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

from a4agent.agent import A4Agent
from a4agent.config import Settings
from a4agent.errors import A4Error, UnknownNameError
from a4agent.requirements import Missing


class Profiles:
    """The profiles a visitor may choose. One agent is in memory at a time."""

    def __init__(
        self,
        settings: Callable[[str], Settings],
        load: Callable[[Settings], A4Agent],
        check: Callable[[Settings], Sequence[Missing]],
        names: Sequence[str],
    ) -> None:
        self.names = tuple(names)
        self._read_settings = settings
        self._load = load
        self._check = check
        self._lock = threading.Lock()
        self._loaded = ""
        self._agent: A4Agent | None = None

    def settings(self, name: str) -> Settings:
        """The settings of a listed profile. A visitor's name is never a path: a TOML file names keys and addresses.

        Raises:
            UnknownNameError: the name is not in the list.
        """
        if name not in self.names:
            raise UnknownNameError(f"unknown profile {name!r}; choose one of {', '.join(self.names)}")
        return self._read_settings(name)

    def agent(self, name: str) -> A4Agent:
        """The agent of a profile.

        Raises:
            A4Error: it cannot be loaded; the next call tries again.
        """
        with self._lock:
            if self._agent is None or name != self._loaded:
                self._let_go()
                self._agent = self._load(self.settings(name))
                self._loaded = name
            return self._agent

    def close(self) -> None:
        """Let go of the models."""
        with self._lock:
            self._let_go()

    def summary(self, name: str) -> str:
        """One line about a profile."""
        try:
            info = self.settings(name).profile
        except A4Error:
            return "its settings cannot be read"
        return " · ".join(part for part in (info.summary, info.memory) if part)

    def dreams(self, name: str) -> bool:
        """Whether a profile has a Dreamer."""
        try:
            return self.settings(name).dreamer is not None
        except A4Error:
            return False

    def missing(self, name: str) -> Sequence[Missing]:
        """What stands between this machine and a profile."""
        try:
            return self._check(self.settings(name))
        except A4Error as error:
            return [Missing(str(error), "a4 doctor")]

    def _let_go(self) -> None:
        if self._agent is not None:
            self._agent.close()
        self._agent = None
