"""Which samples a run on Ray may begin: so many at once, and none after it was told to stop."""

from __future__ import annotations

from typing import Any

from a4agent.errors import require


class Gate:
    """Lets samples in, by their numbers, and knows those under way: at most `room`, so that a stop is soon over."""

    def __init__(self, room: int) -> None:
        self._room = room
        self._open = True
        self._under_way: set[int] = set()  # not a count: Ray sends a batch again when its actor died

    def enter(self, numbers: list[int]) -> bool | None:
        """Whether these may be begun: yes, no more, or (None) ask again later."""
        if self._under_way.issuperset(numbers):
            return True
        if not self._open:
            return False
        if self._under_way and len(self._under_way.union(numbers)) > self._room:
            return None
        self._under_way.update(numbers)
        return True

    def leave(self, numbers: list[int]) -> int:
        """These have been given, or were not begun; returns how many are under way."""
        self._under_way.difference_update(numbers)
        return len(self._under_way)

    def resize(self, room: int) -> None:
        """Have so much room from now on; who is in stays."""
        self._room = room

    def close(self) -> int:
        """Let no more in; returns how many are under way."""
        self._open = False
        return len(self._under_way)


class SharedGate:
    """A gate in a Ray actor of its own, for the run and its actors to ask; the methods are the same."""

    def __init__(self, room: int) -> None:
        ray: Any = require("ray", extra="ray")
        self._actor = ray.remote(num_cpus=0)(Gate).remote(room)

    def enter(self, numbers: list[int]) -> bool | None:
        return _answer(self._actor.enter, numbers)

    def leave(self, numbers: list[int]) -> int:
        return _answer(self._actor.leave, numbers)

    def resize(self, room: int) -> None:
        _answer(self._actor.resize, room)

    def close(self) -> int:
        return _answer(self._actor.close)


def _answer(method: Any, *arguments: Any) -> Any:
    ray: Any = require("ray", extra="ray")
    return ray.get(method.remote(*arguments))
