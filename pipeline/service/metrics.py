"""Counters of the service in Prometheus' text format."""

from collections.abc import Callable

from prometheus_client import (
    CONTENT_TYPE_LATEST,
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    generate_latest,
)

from pipeline.service.photo_map import Located

LATENCY_BUCKETS_S = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
BATCH_BUCKETS = (1, 2, 4, 8, 16, 32, 64)
CONTENT_TYPE = CONTENT_TYPE_LATEST


class ServiceMetrics:
    """Counters of one service; another one in the same process has its own."""

    def __init__(self, waiting: Callable[[], int]) -> None:
        """`waiting` returns how many photos wait for a batch."""
        registry = self._registry = CollectorRegistry()
        self._requests = Counter(
            "pvda_requests",
            "Requests by path and HTTP status.",
            ["path", "status"],
            registry=registry,
        )
        self._seconds = Histogram(
            "pvda_request_seconds",
            "Seconds from a request's head to its response.",
            ["path"],
            buckets=LATENCY_BUCKETS_S,
            registry=registry,
        )
        self._batches = Histogram(
            "pvda_batch_photos",
            "Photos in a batch.",
            buckets=BATCH_BUCKETS,
            registry=registry,
        )
        self._matching = Histogram(
            "pvda_match_seconds",
            "Seconds of framing a photo and matching it with the map.",
            buckets=LATENCY_BUCKETS_S,
            registry=registry,
        )
        self._answers = Counter(
            "pvda_answers",
            "Answers by how their positions came about: tile, refined, none.",
            ["how"],
            registry=registry,
        )
        self._match_failures = Counter(
            "pvda_match_failures", "Photos whose matching failed.", registry=registry
        )
        queue = Gauge("pvda_waiting_photos", "Photos waiting for a batch.", registry=registry)
        queue.set_function(waiting)

    def request(self, path: str, status: int, seconds: float) -> None:
        """Count one response. `path` is one of the service's, or `other`."""
        self._requests.labels(path, str(status)).inc()
        self._seconds.labels(path).observe(seconds)

    def batch(self, photos: int) -> None:
        """Count one batch of this many photos."""
        self._batches.observe(photos)

    def answer(self, located: Located) -> None:
        """Count one answer and how it was matched."""
        position = located.answer.position
        self._answers.labels(position.how if position else "none").inc()
        if located.match_seconds is not None:
            self._matching.observe(located.match_seconds)
        if located.match_error is not None:
            self._match_failures.inc()

    def text(self) -> bytes:
        return generate_latest(self._registry)
