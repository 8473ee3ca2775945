"""The OpenAPI description: complete, and no request that it allows (or nearly) makes the service fail."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import schemathesis
from daemon.conftest import URL, Asked, quick_text
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from ident_service.daemon.app import ROUTERS
from ident_service.daemon.openapi import EXAMPLES
from ident_service.daemon.request_guard import MOST_BODY

FAILURE = {"$ref": "#/components/schemas/Failure"}


@pytest.mark.slow
def test_every_answer_has_a_type_and_every_failure_the_one_shape(daemon: Asked) -> None:
    document = daemon.get("/api/v1/openapi.json").json()
    names = []
    for path, item in document["paths"].items():
        assert path.startswith("/api/v1/") or path in ("/healthz", "/metrics")
        for method, operation in item.items():
            names.append(operation["operationId"])
            assert operation.get("summary"), (method, path)
            for status, answer in operation["responses"].items():
                if status == "204":
                    continue
                content = answer["content"]
                if int(status) >= 400 and status != "503":
                    schema = content["application/json"]["schema"]
                    assert schema == {"$ref": "#/components/schemas/Failure"}, (method, path, status)
                elif "application/json" in content:
                    assert content["application/json"]["schema"] not in ({}, None), (method, path, status)
    assert len(set(names)) == len(names) > 25
    assert "HTTPValidationError" not in json.dumps(document["paths"])


def test_routes_are_made_once_and_not_again_at_the_first_request(daemon: Asked) -> None:
    served = {id(route) for route in daemon.app.routes}
    assert all(id(route) in served for router in ROUTERS for route in router.routes)


@pytest.mark.slow
def test_every_operation_is_explained_by_examples_that_are_good(daemon: Asked) -> None:
    document = daemon.get("/api/v1/openapi.json").json()
    shapes = document["components"]
    used, summaries = set(), []
    for path, item in document["paths"].items():
        for method, operation in item.items():
            summaries.append(operation["summary"])
            assert 10 <= len(operation["summary"]) <= 160, (method, path, operation["summary"])
            body = operation.get("requestBody", {}).get("content", {}).get("application/json")
            if body is not None:
                validator = Draft202012Validator({**body["schema"], "components": shapes})
                used.add(body["schema"]["$ref"].rpartition("/")[2])
                assert body["examples"]
                for title, example in body["examples"].items():
                    validator.validate(example["value"])
                    assert not re.search("[.]$", title)
            for status, answer in operation["responses"].items():
                if answer.get("content", {}).get("application/json", {}).get("schema", {}) == FAILURE:
                    example = answer["content"]["application/json"]["example"]
                    Draft202012Validator({**FAILURE, "components": shapes}).validate(example)
                    assert example["error"]["message"], status
    assert used == set(EXAMPLES)
    assert len(set(summaries)) >= len(summaries) - 2, sorted(summaries)


@pytest.mark.slow
def test_what_an_example_asks_for_is_understood(daemon: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(daemon.service.engine, "_look", lambda: None)  # nothing begins
        for path, name, good in (
            ("/api/v1/arms", "NewArm", {201, 422}),  # of a URDF, three dots are none
            ("/api/v1/jobs", "JobRequest", {201, 404, 409}),
            ("/api/v1/schedules", "NewSchedule", {201}),
            ("/api/v1/recordings/prune", "Pruning", {200}),
        ):
            for title, body in EXAMPLES[name].items():
                answer = daemon.post(path, body)
                assert answer.status_code in good, (title, answer.text)
        for job in daemon.get("/api/v1/jobs").json():
            daemon.post(f"/api/v1/jobs/{job['id']}/cancel")


def test_no_page_of_the_service_loads_anything_from_elsewhere(daemon: Asked) -> None:
    assert daemon.get("/docs").status_code == 404
    assert daemon.get("/redoc").status_code == 404


# Requests whose answer takes as long as a job, or that begin one: jobs are refused for what they name instead.
_LEFT_OUT = {"watch_job", "watch_live", "watch_all"}


def _operations(daemon: Asked) -> dict[str, Any]:
    document = daemon.get("/api/v1/openapi.json").json()
    schema = schemathesis.openapi.from_dict(document)
    found = {}
    for result in schema.get_all_operations():
        operation = result.ok()
        if operation.definition.raw["operationId"] not in _LEFT_OUT:
            found[operation.definition.raw["operationId"]] = operation
    return found


def _statuses(daemon: Asked, operation: Any, examples: int) -> set[int]:
    """Statuses of the answers to some requests that the description allows; each is one that it names."""
    allowed = {int(status) for status in operation.definition.raw["responses"] if status.isdigit()}
    seen = set()

    @settings(
        max_examples=examples,
        deadline=None,
        database=None,
        derandomize=True,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(case=operation.as_strategy())
    def tried(case: Any) -> None:
        words = case.as_transport_kwargs(base_url=URL)
        path = words["url"].removeprefix(URL)
        rest = {key: words[key] for key in ("params", "json", "data", "content") if words.get(key) is not None}
        if isinstance(rest.get("data"), bytes):
            rest["content"] = rest.pop("data")
        answer = daemon.ask(case.method, path, **rest)
        seen.add(answer.status_code)
        assert answer.status_code in allowed, (path, rest, answer.status_code, answer.text[:300])

    tried()
    return seen


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("examples", [2, pytest.param(40, marks=pytest.mark.campaign)])
def test_no_request_makes_the_service_fail(daemon: Asked, monkeypatch: pytest.MonkeyPatch, examples: int) -> None:
    # What is asked for is taken and queued; that the queue runs it is another test's.
    monkeypatch.setattr(daemon.service.engine, "_look", lambda: None)
    operations = _operations(daemon)
    assert len(operations) > 25
    statuses = {name: _statuses(daemon, operation, examples) for name, operation in operations.items()}
    assert all(max(found) < 500 for found in statuses.values()), statuses
    # It was not refused all of the time.
    assert sum(min(found) < 300 for found in statuses.values()) >= 10, statuses


@pytest.mark.slow
@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    body=st.one_of(st.binary(max_size=300), st.text(max_size=300).map(lambda text: text.encode("utf-8", "replace"))),
    path=st.sampled_from(["/api/v1/jobs", "/api/v1/arms", "/api/v1/motions", "/api/v1/login"]),
    kind=st.sampled_from(["application/json", "text/plain", "multipart/form-data; boundary=x", ""]),
)
def test_no_body_makes_the_service_fail(daemon: Asked, body: bytes, path: str, kind: str) -> None:
    answer = daemon.ask("POST", path, content=body, headers={"Content-Type": kind})
    assert answer.status_code in (400, 401, 409, 422, 429), answer.text
    assert set(answer.json()) == {"error"}


@pytest.mark.parametrize("text", ["\ud800", "a\x00b", "𝔸" * 10, "[" * 5000])
def test_strange_text_is_refused_in_words(daemon: Asked, text: str) -> None:
    body = json.dumps({"description": text}).encode()
    assert len(body) < MOST_BODY
    answer = daemon.ask("POST", "/api/v1/arms", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code in (400, 422), answer.text
    body = json.dumps({"arm": "planar2", "motion": text}).encode()
    answer = daemon.ask("POST", "/api/v1/motions", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code in (400, 422), answer.text


def test_an_upload_is_answered_with_every_mistake_and_its_place(daemon: Asked, tmp_path: Path) -> None:
    text = quick_text().replace("velocity: 2,", "velocity: -2,").replace("terms:", "termz:")
    answer = daemon.post("/api/v1/arms", {"description": text})
    assert answer.status_code == 422
    message = answer.json()["error"]["message"]
    assert "arm.yaml:" in message
    assert "termz" in message
    assert "velocity" in message
