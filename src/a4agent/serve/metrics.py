"""What Prometheus reads at `/metrics`. Counters never hold a word of a request."""

from __future__ import annotations

from a4agent.errors import require
from a4agent.types import Affordance

SECONDS = (0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 20, 40, 80, 160, 320)
METHODS = frozenset({"GET", "POST", "HEAD", "OPTIONS", "PUT", "DELETE", "PATCH"})
PATHS = frozenset({"/v1/affordances", "/v1/affordances/batch", "/healthz", "/readyz", "/metrics", "/openapi.json"})


class Metrics:
    """The counters of one server, in a registry of their own."""

    def __init__(self) -> None:
        prometheus = require("prometheus_client", extra="serve")
        self._text = prometheus.generate_latest
        self.content_type: str = prometheus.CONTENT_TYPE_LATEST
        self.registry = prometheus.CollectorRegistry()
        of = {"registry": self.registry}
        self._requests = prometheus.Counter("a4_requests", "HTTP answers", ["method", "path", "code"], **of)
        self._affordances = prometheus.Counter("a4_affordances", "Affordances by status", ["status"], **of)
        self._seconds = prometheus.Histogram(
            "a4_affordance_seconds", "Seconds of model calls for one affordance", buckets=SECONDS, **of
        )
        self._wait = prometheus.Histogram(
            "a4_queue_seconds", "Seconds a job waited for a worker", buckets=SECONDS, **of
        )
        self._stages = prometheus.Histogram(
            "a4_model_call_seconds", "Seconds of one model call", ["stage", "role"], buckets=SECONDS, **of
        )
        self._cost = prometheus.Counter("a4_cost_dollars", "Dollars known to be spent on model calls", **of)
        self.waiting = prometheus.Gauge("a4_queue_waiting", "Jobs that wait for a worker", **of)
        self.working = prometheus.Gauge("a4_queue_working", "Jobs being worked on", **of)

    def answered(self, method: str, path: str, code: int) -> None:
        """Count an HTTP answer; what nobody serves is counted as one, so that callers cannot make labels."""
        known_method, known_path = method if method in METHODS else "other", path if path in PATHS else "other"
        self._requests.labels(known_method, known_path, str(code)).inc()

    def waited(self, seconds: float) -> None:
        self._wait.observe(seconds)

    def predicted(self, affordance: Affordance) -> None:
        """Count one finished affordance, its model calls and what they cost."""
        self._affordances.labels(affordance.status).inc()
        self._seconds.observe(affordance.trace.seconds)
        self._cost.inc(affordance.trace.cost)
        for step in affordance.trace.steps:
            self._stages.labels(step.stage, step.role).observe(step.seconds)

    def text(self) -> bytes:
        """The exposition format."""
        return self._text(self.registry)
