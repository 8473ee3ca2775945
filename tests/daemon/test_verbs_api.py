"""Verbs over the API that are no steps of the commissioning workflow: what each does, and what it refuses."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
from daemon.conftest import Asked, quick_text, serving
from daemon.test_access_control import refusal
from daemon.verbs_bench import ON_A_BUS, answered, on_a_bus, singular_copy, unstable_text, with_arms, with_run

from ident_service.config.load import load_arm
from ident_service.daemon.jobs.commands import command_of_request
from ident_service.daemon.jobs.requests import BusScan, Zero
from ident_service.daemon.request_guard import MOST_UPLOAD
from ident_service.operations.acceptance import accept
from ident_service.registry.arms import known_arm, resources
from ident_service.registry.database import audit_log
from ident_service.registry.tokens import add_token

pytestmark = pytest.mark.slow


def test_what_is_made_of_a_run_is_listed_and_fetched(daemon: Asked, state: Path, commissioned: Path) -> None:
    with_arms(daemon)
    run = with_run(daemon, state, commissioned)
    whole = {path.name: path.read_bytes() for path in (state / "runs" / run).iterdir()}
    ended, said = answered(daemon, {"kind": "feasible", "run": run, "arm": "quick"})
    assert (ended["state"], said["feasible"]) == ("done", True)
    assert said["margin"] > 0

    ended, said = answered(daemon, {"kind": "correct", "run": run})
    assert ended["state"] == "done", ended
    export = daemon.get(f"/api/v1/exports/{ended['run']}").json()
    assert (export["kind"], export["arm"], export["job"], export["made_by"]) == (
        *("correct", "quick"),
        *(ended["id"], "owner"),
    )
    assert list(export["files"]) == ["parameters.json"]
    content = daemon.get(f"/api/v1/exports/{ended['run']}/files/parameters.json")
    assert content.headers["content-disposition"].startswith("attachment")
    assert len(content.content) == export["files"]["parameters.json"]
    corrected = json.loads(content.content)
    assert corrected["method"] == "correction"
    assert corrected["base_parameters"]["values"] == said["values"]
    singular = with_run(daemon, state, singular_copy(commissioned, state.parent / "20260103T000000Z-quick"))
    ended, _ = answered(daemon, {"kind": "correct", "run": singular, "metric": "covariance"})
    assert ended["state"] == "failed"
    assert "singular" in ended["detail"]
    assert [path.name for path in (state / "exports").iterdir()] == [export["id"]]

    ended, said = answered(daemon, {"kind": "figures", "run": run})
    assert ended["state"] == "done", ended
    files = daemon.get(f"/api/v1/exports/{ended['run']}").json()["files"]
    assert set(files) == set(said["files"])
    assert len(files) > 5
    assert all(name.endswith(".svg") for name in files)
    drawing = daemon.get(f"/api/v1/exports/{ended['run']}/files/{said['files'][0]}")
    assert drawing.content.startswith(b"<svg")
    assert drawing.headers["content-type"] == "application/octet-stream"  # to be kept, never shown by us

    # The arm carried nothing when it was validated: a verdict, with files.
    load = {"kind": "payload", "run": run, "recordings": [{"run": run, "name": "validation.mcap"}]}
    ended, said = answered(daemon, load)
    assert (ended["state"], ended["exit_code"], said["verdict"]) == ("refused", 3, "none"), said
    assert "payload.json" in daemon.get(f"/api/v1/exports/{ended['run']}").json()["files"]
    again = load | {"recordings": [{"run": run, "name": "identification.mcap"}]}
    ended, _ = answered(daemon, again)
    assert ended["state"] == "failed"
    assert "was identified from it" in ended["detail"]
    refusal(daemon.get(f"/api/v1/exports/{ended['run']}"), 404)  # it made nothing
    assert {path.name: path.read_bytes() for path in (state / "runs" / run).iterdir()} == whole


def test_only_own_files_of_exports_are_given_away(daemon: Asked, state: Path, commissioned: Path) -> None:
    with_arms(daemon)
    run = with_run(daemon, state, commissioned)
    ended, _ = answered(daemon, {"kind": "export", "run": run, "formats": ["csv"]})
    folder, place = state / "exports" / ended["run"], f"/api/v1/exports/{ended['run']}"
    (folder / "link.csv").symlink_to(state / "token")
    (folder / "inner").mkdir()
    assert list(daemon.get(place).json()["files"]) == [
        path.name for path in folder.iterdir() if path.name not in ("link.csv", "inner")
    ]
    for name in ("link.csv", "inner", "none.csv", "%2e%2e%2f%2e%2e%2ftoken", "..%2ftoken"):
        assert daemon.get(f"{place}/files/{name}").status_code in (404, 422), name
    # A folder that no job has made is no export, nor is a run.
    shutil.copytree(folder, state / "exports" / "stray", symlinks=True)
    refusal(daemon.get("/api/v1/exports/stray"), 404, "no export")
    refusal(daemon.get(f"/api/v1/exports/{run}"), 404, "no export")


@pytest.mark.parametrize("kind", ["feasible", "correct", "figures", "payload", "report", "verify"])
def test_nothing_is_made_of_a_run_that_nobody_knows(daemon: Asked, kind: str) -> None:
    job = {"kind": kind, "run": "none"} | ({"recordings": [{"run": "none"}]} if kind == "payload" else {})
    refusal(daemon.post("/api/v1/jobs", {"job": job}), 404, "no run 'none'")
    refusal(daemon.post("/api/v1/jobs", {"job": job | {"out": "/tmp/x"}}), 422, "out")  # noqa: S108 - refused


def test_an_arms_conditions_are_those_of_a_known_arm(daemon: Asked, state: Path, commissioned: Path) -> None:
    run = with_run(daemon, state, commissioned)
    refusal(daemon.post("/api/v1/jobs", {"job": {"kind": "correct", "run": run, "arm": "none"}}), 404, "no arm")


def test_buses_and_descriptions(daemon: Asked, state: Path) -> None:
    with_arms(daemon)
    ended, said = answered(daemon, {"kind": "bus_load", "arm": ON_A_BUS, "rate": 100.0})
    assert (ended["state"], said["arm"], said["fits"]) == ("done", ON_A_BUS, True)
    ended, said = answered(daemon, {"kind": "bus_load", "arm": ON_A_BUS, "rate": 50_000.0})
    assert (ended["state"], said["fits"]) == ("refused", False)
    ended, said = answered(daemon, {"kind": "bus_scan", "arm": ON_A_BUS})
    assert ended["state"] == "done", ended
    assert said["complete"] is True
    ended, said = answered(daemon, {"kind": "bus_probe", "arm": ON_A_BUS})
    assert (ended["state"], said["good"]) == ("done", True), ended
    for kind in ("bus_load", "bus_scan", "bus_probe"):
        ended, _ = answered(daemon, {"kind": kind, "arm": "quick"})
        assert ended["state"] == "failed"
        refusal(daemon.post("/api/v1/jobs", {"job": {"kind": kind, "arm": "none"}}), 404, "no arm")
    ended, said = answered(daemon, {"kind": "config_check", "arm": "quick"})
    assert (ended["state"], said["stability"]["stable"]) == ("done", True)
    # Who looks at a bus has it for itself.
    arm = known_arm(daemon.service.db, state, ON_A_BUS)
    order = command_of_request(daemon.service.db, state, BusScan(kind="bus_scan", arm=ON_A_BUS))
    assert order.resources == resources(arm.config) == (f"arm {ON_A_BUS}",)
    assert not order.moves


@pytest.mark.parametrize("name", ["wam7_pucks", "wam7_canopen"])
def test_a_motion_reserves_the_bus_of_its_arm(name: str) -> None:
    config = load_arm(name)
    assert resources(config) == (f"arm {name}", "bus socketcan can0")


def test_a_description_is_judged_and_not_kept(daemon: Asked, state: Path) -> None:
    door = "/api/v1/descriptions/check"
    answer = daemon.post(door, {"description": quick_text("unseen")})
    assert (answer.status_code, answer.json()["arm"], answer.json()["stable"]) == (200, "unseen", True), answer.text
    assert "gain margin" in answer.json()["text"]
    answer = daemon.post(door, {"description": unstable_text()})
    assert (answer.status_code, answer.json()["stable"], answer.json()["good"]) == (200, False, False), answer.text
    assert re.match(r"\d+:\d+: gains: ", answer.json()["objections"][0])
    assert answer.json()["text"].splitlines()[0].endswith(": CANNOT MOVE")
    refusal(daemon.post(door, {"description": quick_text().replace("terms:", "termz:")}), 422, r"arm.yaml:\d+:\d+:")
    refusal(daemon.post(door, {"description": "x" * (8 * 2**20 + 1)}), 422)
    refusal(daemon.post(door, {"description": "x", "files": {"y": "z" * (8 * 2**20)}}), 400, "bytes at most")
    refusal(daemon.post(door, {"description": "x" * (MOST_UPLOAD + 1)}), 413)
    assert daemon.post(door, on_a_bus()).status_code == 200
    assert daemon.get("/api/v1/arms/unseen").status_code == 404
    assert list((state / "descriptions").iterdir()) == []
    assert not [line for line in audit_log(daemon.service.db) if line["what"] == "arm added"]
    # Who stores it is told the same.
    objections = daemon.post(door, {"description": unstable_text()}).json()["objections"]
    stored = daemon.post("/api/v1/arms", {"description": unstable_text()})
    assert (stored.status_code, stored.json()["objections"]) == (201, objections), stored.text
    again = daemon.post("/api/v1/arms", {"description": unstable_text()})
    assert (again.status_code, again.json()["objections"]) == (201, None)


def test_an_arm_is_zeroed_by_a_persons_word(daemon: Asked, state: Path) -> None:
    with_arms(daemon)
    posture = daemon.get(f"/api/v1/arms/{ON_A_BUS}/home").json()
    assert [(one["joint"], one["position"], one["unit"]) for one in posture] == [
        ("shoulder", 0.3, "rad"),
        ("elbow", -0.2, "rad"),
    ]
    ended, said = answered(daemon, {"kind": "zero", "arm": ON_A_BUS}, confirmed=True)
    assert (ended["state"], ended["motion"], said["arm"]) == ("done", True, ON_A_BUS), ended
    assert [one["position"] for one in said["posture"]] == [0.3, -0.2]
    refusal(daemon.get("/api/v1/arms/quick/home"), 400, "zero: at_home")
    ended, _ = answered(daemon, {"kind": "zero", "arm": "quick"}, confirmed=True)
    assert ended["state"] == "failed"
    assert "zero: at_home" in ended["detail"]
    word = daemon.challenge(ON_A_BUS)
    body = {"job": {"kind": "zero", "arm": ON_A_BUS}, "confirm": {"name": "quick", "challenge": word}}
    refusal(daemon.post("/api/v1/jobs", body), 409, "typed")


def test_zeroing_waits_for_nothing(state: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with serving(state) as daemon:
        with_arms(daemon)
        monkeypatch.setattr(daemon.service.engine, "_look", lambda: None)  # nothing begins
        db = daemon.service.db
        asked = Zero(kind="zero", arm=ON_A_BUS)
        assert command_of_request(db, state, asked).resources == (f"arm {ON_A_BUS}",)
        daemon.begin({"kind": "recover", "arm": ON_A_BUS})
        body = {"job": {"kind": "zero", "arm": ON_A_BUS}}
        for _ in range(2):
            body["confirm"] = {"name": ON_A_BUS, "challenge": daemon.challenge(ON_A_BUS)}
            refusal(daemon.post("/api/v1/jobs", body), 409, "try again when that has ended")
        assert [job["kind"] for job in daemon.get("/api/v1/jobs").json()] == ["recover"]
        monkeypatch.undo()


def test_recordings_are_named_before_they_are_deleted(daemon: Asked, state: Path, commissioned: Path) -> None:
    db, door = daemon.service.db, "/api/v1/recordings/prune"
    ids = []
    for day in (1, 2, 3):
        folder = shutil.copytree(commissioned, state.parent / "other" / f"2026010{day}T000000Z-quick")
        ids.append(with_run(daemon, state, folder))
        db.write("UPDATE runs SET created = ? WHERE id = ?", float(day), ids[-1])
    accept(db, state, state / "runs" / ids[0], "kept", "me")
    for body in ({"keep": 0}, {"keep": -1}, {"keep": 1, "yes": "true"}, {"keep": 1, "run": ids[2]}, {}):
        refusal(daemon.post(door, body), 422)
    named = daemon.post(door, {"keep": 1}).json()
    assert not named["deleted"]
    assert {one["run"] for one in named["recordings"]} == {ids[1]}
    assert all((state / "runs" / one["run"] / one["name"]).is_file() for one in named["recordings"])
    done = daemon.post(door, {"keep": 1, "yes": True}).json()
    assert done == named | {"deleted": True}
    assert not any((state / "runs" / one["run"] / one["name"]).exists() for one in done["recordings"])
    assert all((state / "runs" / one / "identification.mcap").is_file() for one in (ids[0], ids[2]))
    assert {line["who"] for line in audit_log(db) if line["what"] == "recording deleted"} == {"owner"}
    assert daemon.post(door, {"keep": 1, "yes": True}).json()["recordings"] == []


def test_tokens_are_listed_and_revoked_but_not_made(daemon: Asked, viewer: str) -> None:
    secret = add_token(daemon.service.db, "ann", "operator", "test")
    owner = dict(daemon.headers)
    rows = daemon.get("/api/v1/tokens")
    assert [(row["name"], row["role"], row["revoked"]) for row in rows.json()] == [
        ("owner", "operator", None),
        ("looks", "viewer", None),
        ("ann", "operator", None),
    ]
    assert "sha256" not in rows.text
    assert secret not in rows.text
    assert daemon.post("/api/v1/tokens", {"name": "eve", "role": "operator"}).status_code == 405
    for name in ("none", "..", "OWNER", "a%2fb"):
        assert daemon.post(f"/api/v1/tokens/{name}/revoke").status_code in (404, 405, 422), name
    daemon.as_token(viewer)
    refusal(daemon.get("/api/v1/tokens"), 403, "operator")
    refusal(daemon.post("/api/v1/tokens/ann/revoke"), 403, "operator")
    daemon.headers.update(owner)
    assert daemon.post("/api/v1/tokens/ann/revoke").json()["revoked"] > 0
    refusal(daemon.post("/api/v1/tokens/ann/revoke"), 404)
    daemon.as_token(secret)
    refusal(daemon.get("/api/v1/whoami"), 401)
    assert [
        (line["who"], line["about"]) for line in audit_log(daemon.service.db) if line["what"] == "token revoked"
    ] == [("owner", "ann")]
