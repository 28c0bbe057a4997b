"""Prometheus metrics of the service, for /metrics."""

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

from retrieval.search.query.answer import QueryResult

_SECONDS = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0)


class Metrics:
    """The metrics of one service; each service has its own registry."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.stages = Histogram(
            "retrieve_stage_seconds", "Time of a query by stage", ["stage"], buckets=_SECONDS, registry=self.registry
        )
        self.waiting = Histogram(
            "retrieve_wait_seconds", "Time in the queue before work", buckets=_SECONDS, registry=self.registry
        )
        self.in_flight = Gauge(
            "retrieve_requests_in_flight", "Requests that wait or are being processed", registry=self.registry
        )
        self.verdicts = Counter("retrieve_verdicts", "Answers by verdict", ["verdict"], registry=self.registry)
        self.dropped = Counter(
            "retrieve_dropped", "Requests that were not processed, by reason", ["reason"], registry=self.registry
        )
        self.responses = Counter("retrieve_responses", "Responses by status", ["status"], registry=self.registry)
        self.reloads = Counter("retrieve_reloads", "Generations opened", registry=self.registry)
        self.reload_failures = Counter(
            "retrieve_reload_failures", "Generations that could not be opened", registry=self.registry
        )
        self.history_failures = Counter(
            "retrieve_history_failures",
            "Queries and feedback that could not be stored or recorded",
            ["kind"],
            registry=self.registry,
        )
        self.generation = Gauge("retrieve_generation", "1 for the served generation", ["name"], registry=self.registry)

    def count_answer(self, result: QueryResult) -> None:
        """Count the verdict and the stages of a query."""
        self.verdicts.labels(result.verdict).inc()
        for stage, ms in result.timing_ms.items():
            self.stages.labels(stage).observe(ms / 1e3)

    def set_generation(self, generation: str) -> None:
        """Set the served generation and count the reload."""
        self.generation.clear()
        self.generation.labels(generation).set(1)
        self.reloads.inc()

    def render(self) -> bytes:
        """Return all metrics in the text format of Prometheus."""
        return generate_latest(self.registry)
