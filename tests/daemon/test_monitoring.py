"""Dashboard and alert rules: every figure and label that they name is one that the daemon has."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from daemon.conftest import Asked
from prometheus_client.parser import text_string_to_metric_families

from ident_service.registry.state_folder import arm_fault_store

FOLDER = Path(__file__).parents[2] / "configs" / "monitoring"
_NAME = re.compile(r"\b(?:ident|process)_[a-z_]+\b")
_LABELS = re.compile(r"(\b(?:ident|process)_[a-z_]+)\{([^}]*)\}")
_OF_PROMETHEUS = {"job", "instance"}  # which it adds itself
_SUFFIXES = {"histogram": ("_bucket", "_sum", "_count"), "counter": ("_total",), "gauge": ("",)}


def rules() -> list[dict[str, Any]]:
    document = yaml.safe_load((FOLDER / "ident.rules.yml").read_text(encoding="utf-8"))
    return [rule for group in document["groups"] for rule in group["rules"]]


def panels() -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads((FOLDER / "grafana-dashboard.json").read_text(encoding="utf-8"))["panels"]
    return found


def expressions() -> Iterator[str]:
    yield from (rule["expr"] for rule in rules())
    yield from (target["expr"] for panel in panels() for target in panel["targets"])


@pytest.fixture
def figures(daemon: Asked) -> dict[str, set[str]]:
    """Names of samples that the daemon tells of, each with its labels."""
    arm_fault_store(daemon.service.state, "planar2").latch("overspeed", "too fast")
    daemon.post("/api/v1/stop")
    metrics = daemon.service.metrics
    metrics.record_lease_age(0.5)
    metrics.record_job("run", "done", 1.0, 20.0)
    daemon.service.db.write(
        "INSERT INTO alarms (arm, reidentification, run, what, at) VALUES ('planar2', 'r', 'r', 'x', 0)"
    )
    daemon.service.db.write("INSERT INTO dues (arm, schedule, cause, at, late) VALUES ('planar2', 1, 'x', 0, 0)")
    daemon.follow(daemon.begin({"kind": "base", "arm": "planar2"})["id"])
    found = dict[str, set[str]]()
    for family in text_string_to_metric_families(daemon.get("/metrics").text):
        for suffix in _SUFFIXES[family.type]:
            found[family.name + suffix] = set()
        for sample in family.samples:
            found.setdefault(sample.name, set()).update(sample.labels)
    return found


@pytest.mark.slow
def test_every_figure_and_label_is_there(figures: dict[str, set[str]]) -> None:
    named = [name for expression in expressions() for name in _NAME.findall(expression)]
    assert len(named) > 25
    assert set(named) <= figures.keys(), set(named) - figures.keys()
    # And every figure of ours that is worth a look has a place on the dashboard.
    shown = " ".join(target["expr"] for panel in panels() for target in panel["targets"])
    bases = {re.sub("_(bucket|sum|count|total)$", "", name) for name in figures if name.startswith("ident_")}
    assert {base for base in bases if base not in shown} <= {"ident_http_seconds"}
    for expression in expressions():
        assert expression.count("(") == expression.count(")"), expression
        for name, inside in _LABELS.findall(expression):
            labels = {part.partition("=")[0].rstrip("!") for part in inside.split(",")}
            assert labels <= figures[name] | _OF_PROMETHEUS, expression
        for by in re.findall(r"by \(([^)]*)\)", expression):
            known = set().union(*(figures[name] for name in _NAME.findall(expression)))
            assert {label.strip() for label in by.split(",")} <= known | _OF_PROMETHEUS, expression


def test_rules_name_the_recipient_and_the_action() -> None:
    names = [rule["alert"] for rule in rules()]
    assert len(set(names)) == len(names) >= 8
    for rule in rules():
        assert rule["labels"]["severity"] in ("page", "ticket")
        assert set(rule["annotations"]) == {"summary", "description"}
        for label in re.findall(r"\$labels\.([a-z]+)", " ".join(rule["annotations"].values())):
            assert label in rule["expr"] or "ident_arm_" in rule["expr"], rule["alert"]


def test_prometheus_finds_the_rules_and_the_service() -> None:
    document = yaml.safe_load((FOLDER / "prometheus.yml").read_text(encoding="utf-8"))
    assert [(FOLDER / name).is_file() for name in document["rule_files"]] == [True]
    (job,) = document["scrape_configs"]
    assert (job["job_name"], job["static_configs"][0]["targets"]) == ("ident", ["127.0.0.1:8470"])


def test_panels_do_not_overlap() -> None:
    taken = set[tuple[int, int]]()
    for panel in panels():
        place = panel["gridPos"]
        cells = {
            (x, y)
            for x in range(place["x"], place["x"] + place["w"])
            for y in range(place["y"], place["y"] + place["h"])
        }
        assert not cells & taken, panel["title"]
        assert place["x"] + place["w"] <= 24
        taken |= cells
    assert len({panel["id"] for panel in panels()}) == len(panels())
