"""What a run did: calls made and saved by each expert, samples by status, seconds and dollars."""

from __future__ import annotations

import threading
import time
from collections import Counter
from dataclasses import dataclass, field

from a4agent.types import Affordance, Usage


@dataclass
class ExpertStats:
    """One expert's share. `asked` requests were sent in `batches` calls, `saved` ones answered without a call.

    `seconds` is the sum over calls; `retries` counts requests sent again, `failures` those given up. `cost` is in
    US dollars; `unpriced` counts answers of unknown cost.
    """

    role: str
    id: str
    asked: int = 0
    batches: int = 0
    saved: int = 0
    retries: int = 0
    failures: int = 0
    seconds: float = 0.0
    cost: float = 0.0
    unpriced: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False, compare=False)

    def summary(self) -> str:
        """ "200 asked in 25 calls, 800 saved, 3 retried, 41.6 s, $0.3700", without the counts that are zero."""
        parts = [f"{self.asked} asked in {self.batches} calls"] if self.asked else []
        counts = {"saved": self.saved, "retried": self.retries, "failed": self.failures}
        parts += [f"{count} {name}" for name, count in counts.items() if count]
        parts += [f"{self.seconds:.1f} s"] if self.asked else []
        parts += [f"${self.cost:.4f}"] if self.cost else []
        return ", ".join(parts)

    def count_call(self, requests: int, seconds: float) -> None:
        with self._lock:
            self.asked += requests
            self.batches += 1
            self.seconds += seconds

    def count_answer(self, usage: Usage) -> None:
        with self._lock:
            if usage.cached:
                self.saved += 1
            elif usage.cost is None:
                self.unpriced += 1
            else:
                self.cost += usage.cost

    def count_retry(self) -> None:
        with self._lock:
            self.retries += 1

    def count_failure(self, usage: Usage | None) -> None:
        """Count a request given up; `usage` is that of an answer which was paid for but cannot be used."""
        with self._lock:
            self.failures += 1
            self.cost += (usage and usage.cost) or 0.0


class Stats:
    """Filled by `engine.run(..., stats=stats)` as it runs, and complete when it is over."""

    def __init__(self) -> None:
        self.experts: dict[str, ExpertStats] = {}
        self.samples: Counter[str] = Counter()
        self._started = time.monotonic()
        self._lock = threading.Lock()

    @property
    def asked(self) -> int:
        """Requests sent to experts."""
        return sum(expert.asked for expert in self.experts.values())

    @property
    def saved(self) -> int:
        """Requests answered by the cache or an identical request in flight."""
        return sum(expert.saved for expert in self.experts.values())

    @property
    def cost(self) -> float:
        """US dollars, where prices are known."""
        return sum(expert.cost for expert in self.experts.values())

    @property
    def seconds(self) -> float:
        """Wall time since the start."""
        return time.monotonic() - self._started

    def of(self, role: str, id: str) -> ExpertStats:
        """The share of one expert in one role."""
        return self.experts.setdefault(f"{role} {id}", ExpertStats(role, id))

    def count_sample(self, affordance: Affordance) -> None:
        with self._lock:
            self.samples[affordance.status] += 1

    def lines(self) -> list[str]:
        """One line for each expert that was used, for people."""
        return [f"{e.role:9} {e.id}: {e.summary()}" for e in self.experts.values() if e.asked or e.saved]
