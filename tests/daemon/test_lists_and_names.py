"""Lists come in pages that lose and repeat nothing; a name that is taken is replaced only where that is asked for."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from daemon.conftest import Asked, quick_text
from daemon.test_access_control import refusal

from ident_service.registry import jobs as rows
from ident_service.registry.database import Database, audit_log, note
from ident_service.registry.tokens import add_token

COUNT = 12


def fill_runs(db: Database, number: int) -> None:
    # Several of one second: their ids decide.
    db.write(
        "INSERT INTO runs VALUES (?, 'motion', ?, NULL, ?, 'done', NULL, 0.0, NULL)",
        *(f"r{number:02d}", ("a", "b")[number % 2], float(number // 3)),
    )


def fill_motions(db: Database, number: int) -> None:
    db.write("INSERT INTO motions VALUES (?, 'planar2', 'm', 1.0, 'x', ?, 'me')", f"m{number:02d}", float(number // 3))


def fill_again(db: Database, number: int) -> None:
    db.write(
        "INSERT INTO reidentifications VALUES (?, 'planar2', 'judge', 'changed', NULL, 1, 0, NULL, NULL, NULL, '', ?, "
        "'me', 5.0)",
        *(f"a{number:02d}", float(number // 3)),
    )


def fill_alarms(db: Database, number: int) -> None:
    db.write("INSERT INTO alarms (arm, reidentification, run, what, at) VALUES ('a', 'x', 'y', 'z', ?)", float(number))


def fill_events(db: Database, number: int) -> None:
    db.write("INSERT INTO maintenance_events VALUES (?, 'planar2', 'oil', '', 1.0, 'me')", number + 1)


def fill_jobs(db: Database, number: int) -> None:
    rows.add_job(db, f"j{number}", "base", "planar2", {}, [], "me", motion=False, run_id=None)
    rows.mark_ended(db, f"j{number}", "done", "")


def fill_audit(db: Database, number: int) -> None:
    note(db, "me", "did", str(number))


@pytest.mark.parametrize(
    ("path", "fill", "key"),
    [
        pytest.param("/api/v1/runs", fill_runs, "id", id="runs"),
        pytest.param("/api/v1/runs?arm=b", fill_runs, "id", id="runs of an arm"),
        pytest.param("/api/v1/motions", fill_motions, "id", id="motions"),
        pytest.param("/api/v1/reidentifications", fill_again, "id", id="re-identifications"),
        pytest.param("/api/v1/alarms?closed=true", fill_alarms, "id", id="alarms"),
        pytest.param("/api/v1/arms/planar2/maintenance", fill_events, "id", id="maintenance"),
        pytest.param("/api/v1/jobs?state=done&state=failed", fill_jobs, "number", id="jobs"),
        pytest.param("/api/v1/audit", fill_audit, "id", id="audit"),
    ],
)
def test_a_list_is_the_sum_of_its_pages(
    daemon: Asked, path: str, fill: Callable[[Database, int], None], key: str
) -> None:
    for number in range(COUNT):
        fill(daemon.service.db, number)
    whole = daemon.get(path)
    assert whole.status_code == 200, whole.text
    assert len(whole.json()) >= COUNT // 2
    assert "link" not in whole.headers
    assert {name for one in whole.json() for name in one} >= {key}
    for most in (1, 5, len(whole.json())):
        found: list[Any] = []
        after: str | None = f"{path}{'&' if '?' in path else '?'}most={most}"
        while after is not None:
            page = daemon.get(after)
            assert len(page.json()) <= most
            found += page.json()
            link = re.fullmatch(r'<(/api/v1/\S+)>; rel="next"', page.headers.get("link", ""))
            after = None if link is None else link.group(1)
        assert found == whole.json()


def test_a_page_after_what_is_not_there_is_refused(daemon: Asked) -> None:
    for path in ("runs", "motions", "reidentifications"):
        refusal(daemon.get(f"/api/v1/{path}?before=nothing"), 404)
        refusal(daemon.get(f"/api/v1/{path}?before=../x"), 422)


def test_a_computation_that_is_requested_twice_is_one_job(daemon: Asked, viewer: str) -> None:
    base: dict[str, object] = {"job": {"kind": "base", "arm": "planar2"}}

    def post(key: str, body: dict[str, object] = base) -> Any:
        return daemon.post("/api/v1/jobs", body, headers={"Idempotency-Key": key})

    with ThreadPoolExecutor(8) as clients:
        answers = list(clients.map(post, ["first"] * 8))
    assert [answer.status_code for answer in answers] == [201] * 8, [answer.text for answer in answers]
    assert len({answer.json()["id"] for answer in answers}) == 1
    assert sorted(answer.headers.get("idempotent-replayed", "") for answer in answers) == ["", *["true"] * 7]
    assert len(rows.jobs(daemon.service.db)) == 1
    assert len(list((daemon.service.state / "jobs").iterdir())) == 1
    refusal(post("first", {"job": {"kind": "base", "arm": "sixaxis"}}), 409, "used for another request")
    assert post("second").json()["id"] != answers[0].json()["id"]
    for key in ("a b", "", "x" * 201):
        refusal(post(key), 422)
    body = {"job": {"kind": "home", "arm": "planar2"}, "confirm": {"name": "planar2", "challenge": "x"}}
    refusal(post("third", body), 400, "its challenge is valid once")
    # Another token has keys of its own, and a day later a key is forgotten.
    daemon.service.db.write("UPDATE idempotency_keys SET at = at - 90000")
    assert "idempotent-replayed" not in post("first").headers
    daemon.as_token(add_token(daemon.service.db, "other", "operator", "test"))
    assert "idempotent-replayed" not in post("second").headers


@pytest.mark.slow
def test_a_name_that_is_taken_is_replaced_where_that_is_requested(daemon: Asked) -> None:
    def post(text: str, **more: object) -> Any:
        return daemon.post("/api/v1/arms", {"description": text, **more})

    assert post(quick_text()).status_code == 201
    assert post(quick_text()).status_code == 201  # the same once more
    refusal(post(quick_text(periods=8)), 409, "already, uploaded")
    assert daemon.get("/api/v1/arms/quick").json()["sha256"] == post(quick_text()).json()["sha256"]
    assert post(quick_text(periods=8), replace=True).status_code == 201
    refusal(post(quick_text("planar2")), 409, "shipped")
    assert daemon.get("/api/v1/arms/planar2").json()["source"] == "shipped"
    assert post(quick_text("planar2"), replace=True).json()["source"] == "uploaded"
    refusal(daemon.post("/api/v1/descriptions/check", {"description": quick_text(), "replace": True}), 422)
    assert len([line for line in audit_log(daemon.service.db) if line["what"] == "arm added"]) == 5


@pytest.mark.slow
def test_a_name_that_no_address_can_have_is_refused_with_its_place(daemon: Asked) -> None:
    assert daemon.post("/api/v1/arms", {"description": quick_text("a" * 64)}).status_code == 201
    assert daemon.get(f"/api/v1/arms/{'a' * 64}").status_code == 200
    for length in (65, 300):
        answer = daemon.post("/api/v1/arms", {"description": quick_text("a" * length)})
        assert answer.status_code == 422
        assert re.match(r"arm.yaml:\d+:\d+: name: ", answer.json()["error"]["message"])
        assert str(daemon.service.state) not in answer.text


def test_a_motion_of_another_number_of_joints_is_not_taken(daemon: Asked) -> None:
    head = {"format": "ident-excitation", "version": 1, "name": "three", "arm": {"sha256": "a"}, "kind": "postures"}
    three = head | {"points": [[0.0, 0.0, 0.0], [0.1, 0.1, 0.1]], "times": [1.0], "dwell": 1.0}
    answer = daemon.post("/api/v1/motions", {"arm": "planar2", "motion": json.dumps(three)})
    assert answer.status_code == 400, answer.text
    assert "a motion of 3 joints, but planar2 has 2" in answer.json()["error"]["message"]
    assert daemon.get("/api/v1/motions").json() == []
    two = three | {"points": [[0.0, 0.0], [0.1, 0.1]]}
    answer = daemon.post("/api/v1/motions", {"arm": "planar2", "motion": json.dumps(two)})
    assert answer.status_code == 201, answer.text
