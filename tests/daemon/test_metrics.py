"""Figures: read by Prometheus' own parser, and true of what was done."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from daemon.conftest import Asked
from prometheus_client.parser import text_string_to_metric_families

from ident_service.daemon.jobs.outcome import lateness_of
from ident_service.daemon.jobs.requests import Run
from ident_service.daemon.metrics import Metrics
from ident_service.motion.cycle_timing import Histogram


def figures(text: str) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
    """Every sample by its name and labels."""
    found = {}
    for family in text_string_to_metric_families(text):
        assert family.documentation
        for sample in family.samples:
            found[sample.name, frozenset(sample.labels.items())] = sample.value
    return found


def of(daemon: Asked, name: str, **labels: str) -> float:
    return figures(daemon.get("/metrics").text)[name, frozenset(labels.items())]


@pytest.mark.slow
def test_what_is_done_is_counted(daemon: Asked) -> None:
    assert daemon.get("/metrics").headers["content-type"].startswith("text/plain; version=0.0.4")
    assert of(daemon, "ident_up") == 1
    assert of(daemon, "ident_stop_seconds_count") == 0
    daemon.post("/api/v1/stop")
    daemon.post("/api/v1/arms/planar2/stop")
    daemon.get("/api/v1/arms/stop")
    assert of(daemon, "ident_stop_seconds_count") == 2
    assert 0 < of(daemon, "ident_stop_seconds_sum") < 20
    assert of(daemon, "ident_stop_seconds_bucket", le="+Inf") == 2
    assert of(daemon, "ident_http_requests_total", method="POST", status="200") == 2
    assert of(daemon, "ident_http_request_seconds_count", method="GET") >= 4
    assert of(daemon, "ident_http_seconds_total") > 0
    assert of(daemon, "process_open_fds") > 5


@pytest.mark.slow
def test_jobs_are_counted_when_they_have_ended(daemon: Asked) -> None:
    job = daemon.follow(daemon.begin({"kind": "base", "arm": "planar2"})["id"])
    assert of(daemon, "ident_job_seconds_count", kind="base", state="done") == 1
    seconds = job["ended"] - job["started"]
    assert of(daemon, "ident_job_seconds_sum", kind="base", state="done") == pytest.approx(seconds)
    assert of(daemon, "ident_job_wait_seconds_count", kind="base") == 1
    assert of(daemon, "ident_jobs", kind="base", state="done") == 1


def test_the_age_of_a_lease_is_that_of_its_renewal(daemon: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    engine, now = daemon.service.engine, [100.0]
    monkeypatch.setattr(engine.live, "_now", lambda: now[0])
    monkeypatch.setattr(engine.live, "may_begin", lambda live, most_computing: False)  # it waits
    monkeypatch.setattr(engine, "_now", lambda: now[0])
    job = engine.create(Run(kind="run", arm="planar2"), "owner")["id"]
    for seconds in (0.3, 1.6):
        now[0] += seconds
        assert engine.live.renew(job) is not None
    assert of(daemon, "ident_lease_age_seconds_count") == 2
    assert of(daemon, "ident_lease_age_seconds_bucket", le="0.5") == 1
    assert of(daemon, "ident_lease_age_seconds_sum") == pytest.approx(1.9)
    engine.cancel(job, "owner")
    monkeypatch.undo()


def test_lateness_is_the_sum_of_the_runs() -> None:
    metrics, late = Metrics(), Histogram()
    for time_ns in (500, 1_500, 1_500, 40_000, 10**9):
        late.add(time_ns)
    for document in (late.document(), late.document(), None, {"edges_us": [1], "counts": [1]}, {"edges_us": "x"}):
        metrics.add_lateness(document)
    found = figures(metrics.text({}, (), {}, {}, {}))
    buckets = {
        float(dict(labels)["le"]): value
        for (name, labels), value in found.items()
        if name == "ident_cycle_lateness_seconds_bucket"
    }
    assert [buckets[edge] for edge in (1e-6, 2e-6, 5e-5, 0.1)] == [2, 6, 8, 8]
    assert buckets[float("inf")] == 10


def test_lateness_is_read_from_what_a_run_wrote_down(tmp_path: Path) -> None:
    late = Histogram()
    late.add(7_000)
    file = tmp_path / "ended.json"
    for text, found in (
        (json.dumps({"lateness": late.document()}), late.document()),
        (json.dumps({"lateness": None}), None),
        ("[]", None),
        ("{", None),
    ):
        file.write_text(text)
        assert lateness_of(tmp_path) == found
