"""Figures of the service in Prometheus' text format (version 0.0.4), counted by hand: there are few."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterable, Mapping

_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})


class Metrics:
    """Counters of requests."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._requests: Counter[tuple[str, int]] = Counter()
        self._seconds = 0.0

    def request(self, method: str, status: int, seconds: float) -> None:
        """Count one request."""
        with self._lock:
            self._requests[method if method in _METHODS else "other", status] += 1
            self._seconds += seconds

    def text(
        self,
        jobs: Mapping[tuple[str, str], int],
        moving: Iterable[str],
        faults: Mapping[str, int],
        due: Mapping[str, int],
        alarms: Mapping[str, int],
    ) -> str:
        """All figures.

        Args:
            jobs: number by kind and state.
            moving: names of arms that somebody moves.
            faults: number of latched faults by arm.
            due: number of re-identifications that are due, by arm.
            alarms: number of drift alarms that stand, by arm.
        """
        with self._lock:
            requests, seconds = dict(self._requests), self._seconds
        lines = ["# TYPE ident_up gauge", "ident_up 1", "# TYPE ident_http_requests_total counter"]
        lines += [
            f'ident_http_requests_total{{method="{method}",status="{status}"}} {count}'
            for (method, status), count in sorted(requests.items())
        ]
        lines += ["# TYPE ident_http_seconds_total counter", f"ident_http_seconds_total {seconds!r}"]
        lines.append("# TYPE ident_jobs gauge")
        lines += [
            f'ident_jobs{{kind="{kind}",state="{state}"}} {count}' for (kind, state), count in sorted(jobs.items())
        ]
        lines.append("# TYPE ident_arm_moving gauge")
        lines += [f'ident_arm_moving{{arm="{arm}"}} 1' for arm in sorted(moving)]
        for name, counts in (("faults", faults), ("due", due), ("drift_alarms", alarms)):
            lines.append(f"# TYPE ident_arm_{name} gauge")
            lines += [f'ident_arm_{name}{{arm="{arm}"}} {count}' for arm, count in sorted(counts.items())]
        return "\n".join([*lines, ""])
