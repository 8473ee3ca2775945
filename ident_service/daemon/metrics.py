"""Collect the metrics of the service for Prometheus, with its own client library.

| figure | tells |
|---|---|
| `ident_stop_seconds` | how long a stop took, from its request to its answer, when every process has been told |
| `ident_lease_age_seconds` | how old a lease was when it was renewed: near its end, a motion is about to be stopped |
| `ident_cycle_lateness_seconds` | how late cycles of runs woke, from what each run wrote down |
| `ident_job_seconds`, `ident_job_wait_seconds` | how long jobs took, and waited |

Counts are since the service was started. Gauges are read from the registry at each request.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator, Mapping
from itertools import accumulate
from typing import Any, Final

from prometheus_client import CollectorRegistry, Counter, Histogram, disable_created_metrics, generate_latest
from prometheus_client.core import GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.process_collector import ProcessCollector
from prometheus_client.registry import Collector

disable_created_metrics()  # type: ignore[no-untyped-call]
_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
_STOP: Final = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
_LEASE: Final = (0.05, 0.1, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0, 5.0)
_REQUEST: Final = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)
_JOB: Final = (1.0, 2.0, 5.0, 10.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0, 14400.0)
Sizes = Mapping[str, int]


class Metrics:
    """Counters and histograms; may be used from any thread, and never waits."""

    def __init__(self) -> None:
        self._registry = registry = CollectorRegistry()
        ProcessCollector(registry=registry)
        self._requests = Counter(
            "ident_http_requests", "Requests that were answered.", ["method", "status"], registry=registry
        )
        self._seconds = Counter("ident_http_seconds", "Time that answers took.", registry=registry)
        self._request = Histogram(
            "ident_http_request_seconds",
            "Time of an answer; of streams, until their end.",
            ["method"],
            buckets=_REQUEST,
            registry=registry,
        )
        self._stop = Histogram(
            "ident_stop_seconds", "Time of a stop, from request to answer.", buckets=_STOP, registry=registry
        )
        self._lease = Histogram(
            "ident_lease_age_seconds", "Age of a lease when it was renewed.", buckets=_LEASE, registry=registry
        )
        self._job = Histogram(
            "ident_job_seconds", "Time of a job that has ended.", ["kind", "state"], buckets=_JOB, registry=registry
        )
        self._wait = Histogram(
            "ident_job_wait_seconds", "Time that a job waited.", ["kind"], buckets=_JOB, registry=registry
        )
        self._lateness = _Lateness()
        registry.register(self._lateness)

    def record_request(self, method: str, status: int, seconds: float, *, is_stop: bool = False) -> None:
        """Count one request by method and status, and its duration [s], also among stops if it was one."""
        known = method if method in _METHODS else "other"
        self._requests.labels(known, str(status)).inc()
        self._seconds.inc(seconds)
        self._request.labels(known).observe(seconds)
        if is_stop:
            self._stop.observe(seconds)

    def record_lease_age(self, lease_age: float) -> None:
        """Record how old [s] a lease was when it was renewed."""
        self._lease.observe(lease_age)

    def record_job(self, kind: str, state: str, waited_seconds: float, ran_seconds: float | None) -> None:
        """Record a job that has ended.

        Args:
            kind: of the job.
            state: final state of the job.
            waited_seconds: time before it began or was cancelled [s].
            ran_seconds: time from its beginning to its end [s]; None for one that never began.
        """
        self._wait.labels(kind).observe(waited_seconds)
        if ran_seconds is not None:
            self._job.labels(kind, state).observe(ran_seconds)

    def add_lateness(self, histogram: Any) -> None:
        """Add a run's lateness histogram, `lateness` of its `ended.json`; one of another form is left out."""
        self._lateness.add(histogram)

    def text(
        self, jobs: Mapping[tuple[str, str], int], moving: Iterable[str], faults: Sizes, due: Sizes, alarms: Sizes
    ) -> str:
        """Return all metrics in Prometheus' text format.

        Args:
            jobs: number by kind and state.
            moving: names of arms that somebody moves.
            faults: number of latched faults by arm.
            due: number of re-identifications that are due, by arm.
            alarms: number of drift alarms that stand, by arm.
        """
        now = CollectorRegistry()
        now.register(_Now(jobs, dict.fromkeys(sorted(moving), 1), faults, due, alarms))
        return (generate_latest(self._registry) + generate_latest(now)).decode()


class _Now(Collector):
    """Collector of gauges: the present state of the registry and the arms' files."""

    def __init__(self, jobs: Mapping[tuple[str, str], int], moving: Sizes, faults: Sizes, due: Sizes, alarms: Sizes):
        self._jobs, self._arms = jobs, {"moving": moving, "faults": faults, "due": due, "drift_alarms": alarms}

    def collect(self) -> Iterator[Metric]:
        yield GaugeMetricFamily("ident_up", "Whether the service answers.", value=1)
        family = GaugeMetricFamily("ident_jobs", "Jobs that the registry knows.", labels=["kind", "state"])
        for names, count in sorted(self._jobs.items()):
            family.add_metric(names, count)
        yield family
        for name, words in (
            ("moving", "Whether the arm is moving."),
            ("faults", "Faults that nobody has acknowledged."),
            ("due", "Re-identifications that are due."),
            ("drift_alarms", "Open drift alarms."),
        ):
            family = GaugeMetricFamily(f"ident_arm_{name}", words, labels=["arm"])
            for arm, count in sorted(self._arms[name].items()):
                family.add_metric([arm], count)
            yield family


class _Lateness(Collector):
    """Collector of the wake-up lateness of cycles: sums of the runs' own histograms (`motion/cycle_timing.py`)."""

    def __init__(self) -> None:
        self._lock, self._edges, self._counts = threading.Lock(), list[float](), list[int]()

    def add(self, document: Any) -> None:
        """Add the histogram of one run; a document of another form is left out."""
        if not isinstance(document, dict):
            return
        edges, counts = document.get("edges_us"), document.get("counts")
        if not (isinstance(edges, list) and isinstance(counts, list) and len(counts) == len(edges) + 1):
            return
        if not all(isinstance(one, int) and one >= 0 for one in (*edges, *counts)):
            return
        with self._lock:
            if not self._edges:
                self._edges, self._counts = edges, [0] * len(counts)
            if edges == self._edges:
                self._counts = [one + more for one, more in zip(self._counts, counts, strict=True)]

    def collect(self) -> Iterator[Metric]:
        """Yield the histogram; its sum is not known."""
        family = HistogramMetricFamily("ident_cycle_lateness_seconds", "How late cycles of runs woke.")
        with self._lock:
            names = [*(repr(edge / 1e6) for edge in self._edges), "+Inf"]
            totals = list(accumulate(self._counts)) or [0]
        family.add_metric([], list(zip(names, totals, strict=True)), sum_value=None)
        yield family
