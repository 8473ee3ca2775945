"""The daemon re-identifies: asked by a person who keeps the lease, and by itself where that is allowed."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from daemon.conftest import Asked, serving
from daemon.conftest import viewer as viewer
from daemon.served import daemon_process, url_of
from maintenance.conftest import ARM, description

from ident_service.cli import main
from ident_service.client import IdentClient
from ident_service.errors import IdentError
from ident_service.registry.database import Database
from ident_service.registry.state_folder import arm_fault_store
from ident_service.registry.tokens import add_token

pytestmark = pytest.mark.slow


@pytest.fixture
def daemon(accepted: str, state: Path) -> Iterator[Asked]:
    """A service on the state folder of the accepted arm."""
    with serving(state) as asked:
        yield asked


def upload(daemon: Asked, text: str) -> None:
    assert daemon.post("/api/v1/arms", {"description": text, "replace": True}).status_code == 201


def followed(daemon: Asked, name: str) -> dict[str, Any]:
    """A re-identification that nobody renews the lease of, when it has ended."""
    while (seen := dict(daemon.get(f"/api/v1/reidentifications/{name}").json()))["state"] == "running":
        time.sleep(0.3)
    return seen


def test_what_is_due_waits_for_a_person_who_types_the_name(daemon: Asked, viewer: str) -> None:
    assert daemon.post("/api/v1/schedules", {"arm": ARM, "maintenance": True}).status_code == 201
    assert daemon.post(f"/api/v1/arms/{ARM}/maintenance", {"what": "belt changed"}).status_code == 201
    (due,) = daemon.get("/api/v1/due").json()
    assert 'ident_arm_due{arm="quick"} 1.0\n' in daemon.get("/metrics").text
    assert due["cause"] == "maintenance: belt changed"
    time.sleep(2.0)  # time enough for four looks
    assert daemon.get("/api/v1/jobs").json() == []  # it asks for a person, and does nothing

    body = {"arm": ARM, "confirm": {"name": ARM, "challenge": "made up"}}
    assert daemon.post("/api/v1/reidentifications", {"arm": ARM}).status_code == 409
    assert daemon.post("/api/v1/reidentifications", body).status_code == 409
    looks = {"headers": {"Authorization": f"Bearer {viewer}"}}
    body = {"arm": ARM, "confirm": {"name": ARM, "challenge": daemon.challenge(ARM)}}
    assert daemon.post("/api/v1/reidentifications", body, **looks).status_code == 403
    assert daemon.get("/api/v1/reidentifications").json() == []


def test_an_allowed_arm_does_it_by_itself_and_stops_when_it_is_told_to(daemon: Asked) -> None:
    upload(daemon, description(seed=32, unattended="allowed"))
    assert daemon.post("/api/v1/schedules", {"arm": ARM, "maintenance": True}).status_code == 201

    def begun(what: str) -> dict[str, Any]:
        daemon.post(f"/api/v1/arms/{ARM}/maintenance", {"what": what})
        until = time.monotonic() + 60.0
        while time.monotonic() < until:
            seen = daemon.get("/api/v1/reidentifications").json()
            if seen and seen[0]["state"] == "running":
                return dict(seen[0])
            time.sleep(0.1)
        raise AssertionError(seen)

    ended = followed(daemon, begun("gear oil changed")["id"])
    assert (ended["state"], ended["begun_by"], ended["unattended"]) == ("unchanged", "service", True)
    assert daemon.get("/api/v1/alarms").json() == daemon.get("/api/v1/due").json() == []

    again = begun("and the other gear")
    assert daemon.post(f"/api/v1/arms/{ARM}/stop").status_code == 200
    stopped = followed(daemon, again["id"])
    assert stopped["state"] in ("cancelled", "failed"), stopped
    time.sleep(1.5)
    assert [job["kind"] for job in daemon.get("/api/v1/jobs").json()].count("run") == 1
    assert len(daemon.get("/api/v1/due").json()) == 1  # nothing was found out, so it is due still


def test_a_lease_that_nobody_renews_ends_it(daemon: Asked) -> None:
    daemon.service.engine.live.lease_factor = 0.1  # of two seconds
    body = {"arm": ARM, "confirm": {"name": ARM, "challenge": daemon.challenge(ARM)}}
    name = daemon.post("/api/v1/reidentifications", body).json()["id"]
    ended = followed(daemon, name)
    assert ended["state"] == "cancelled", ended
    assert [job["kind"] for job in daemon.get("/api/v1/jobs").json()] == ["check"]


@pytest.mark.campaign
def test_a_person_asks_by_the_command_and_a_drier_joint_is_found(
    accepted: str, state: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def ident(*words: str) -> tuple[int, str, str]:
        capsys.readouterr()
        code = main([*words, "--server", url, "--state", str(state)])
        said = capsys.readouterr()
        return code, re.sub(r"(?m)^next: ident .*\n\Z", "", said.out), said.err

    with daemon_process(state) as (process, client):
        url = url_of(process, state)
        client.post("/api/v1/arms", {"description": description(seed=31, drier=1.3), "replace": True})
        assert "next 20" in ident("schedule", "add", ARM, "--cron", "0 6 * * mon")[1]
        assert ident("schedule", "add", ARM, "--maintenance")[0] == 0
        assert ident("schedule", "disable", "1")[1].endswith(", disabled\n")
        assert "(UTC), next" in ident("schedule", "enable", "1")[1]
        assert ident("schedule", "remove", "1")[0] == 0
        assert ident("schedule", "list", ARM)[1].count("\n") == 1
        assert "maintenance: belt" in ident("maintenance", ARM, "--what", "belt")[1]
        assert "maintenance: belt; `ident reidentify" in ident("due", "list")[1]
        assert ident("maintenance", "planar2", "--what", "belt")[0] == 0
        assert ident("schedules", "add", "planar2", "--maintenance")[0] == 0
        assert "nothing of it has been accepted" in ident("maintenance", "planar2", "--what", "oil")[1]
        (other,) = [row for row in client.get("/api/v1/due") if row["arm"] == "planar2"]
        assert ident("due", "dismiss", str(other["id"]), "--note", "never commissioned")[0] == 0
        assert "cannot be sent to a daemon" in ident("maintenance", ARM, "--what", "belt", "--by", "ann")[2]
        assert ident("alarm", "list")[:2] == (0, "no open alarms\n")
        assert ident("alarm", "ack", "1", "--note", "x")[0] == 2
        assert ident("reidentify", ARM, "--confirm", "other")[0] == 2
        code, out, _ = ident("reidentify", ARM, "--confirm", ARM)
        assert (code, "friction of joint elbow" in out) == (3, True)
        (ended,) = client.get("/api/v1/reidentifications")
        assert ended["state"] == "changed", ended
        assert "friction of joint elbow" in ended["detail"]
        assert [(job["kind"], job["state"]) for job in reversed(client.get("/api/v1/jobs"))] == [
            ("check", "done"),
            ("run", "done"),
            ("identify", "done"),
            ("judge", "refused"),
        ]
        files = client.get(f"/api/v1/runs/{ended['run']}")["files"]
        assert {"comparison.json", "comparison.html", "parameters.json"} <= set(files)
        assert ident("due", "list")[1] == "nothing is due\n"
        assert ident("maintenance", ARM, "--what", "belt again")[0] == 0
        assert ident("due", "dismiss", "3", "--note", "the same belt")[0] == 0

        (alarm,) = client.get("/api/v1/alarms")
        assert (alarm["run"], "friction of joint elbow" in alarm["what"]) == (ended["run"], True)
        assert b'ident_arm_drift_alarms{arm="quick"} 1.0\n' in client.content("/metrics")
        with Database(state) as db:
            secret = add_token(db, "looks", "viewer", "test")
        with IdentClient(url, secret) as looks:
            assert looks.get("/api/v1/alarms") == [alarm]
            for path, body in (
                (f"/api/v1/alarms/{alarm['id']}/ack", {"note": "x"}),
                (f"/api/v1/reidentifications/{ended['id']}/lease", None),
            ):
                with pytest.raises(IdentError, match="this needs the role operator"):
                    looks.post(path, body)
        client.post(f"/api/v1/arms/{ARM}/acceptances", {"run": ended["run"], "note": "dry seal, known"})
        assert client.get("/api/v1/alarms") == []
        assert ident("alarm", "list")[:2] == (0, "no open alarms\n")
        assert ident("alarm", "ack", "1", "--note", "x")[0] == 2
        # An arm that a person must look at first is not told as one that has changed, which is exit code 3.
        arm_fault_store(state, ARM).latch("lease_lost", "nobody was there")
        code, out, err = ident("reidentify", ARM, "--confirm", ARM)
        assert (code, "lease_lost" in out + err) == (5, True)


@pytest.mark.parametrize(
    "step", ["run", *(pytest.param(step, marks=pytest.mark.campaign) for step in ("check", "identify"))]
)
def test_a_kill_in_the_midst_is_reported_and_nothing_moves_by_itself(accepted: str, state: Path, step: str) -> None:
    path = "/api/v1/reidentifications"
    with daemon_process(state) as (process, client):
        client.post("/api/v1/arms", {"description": description(seed=34), "replace": True})
        word = client.post(f"/api/v1/arms/{ARM}/challenge")["challenge"]
        row = client.post(path, {"arm": ARM, "confirm": {"name": ARM, "challenge": word}})
        while not (row["step"] == step and client.get(f"/api/v1/jobs/{row['job']}")["state"] == "running"):
            assert row["state"] == "running", row
            client.post(f"{path}/{row['id']}/lease")
            time.sleep(0.1)
            row = client.get(f"{path}/{row['id']}")
        process.kill()
        process.wait()
    with daemon_process(state) as (_, client):
        until = time.monotonic() + 120.0
        while (row := client.get(f"{path}/{row['id']}"))["state"] == "running" and time.monotonic() < until:
            time.sleep(0.1)
        assert (row["state"], row["step"]) == ("interrupted", step)
        assert "the service died while it ran" in row["detail"]
        time.sleep(1.5)
        kinds = [job["kind"] for job in reversed(client.get("/api/v1/jobs"))]
        assert kinds == ["check", "run", "identify"][: len(kinds)]
        assert kinds[-1] == step
        assert client.get("/api/v1/alarms") == []
        if step == "identify":  # what was recorded is there to be identified from
            files = client.get(f"/api/v1/runs/{row['recorded']}")["files"]
            assert "run.mcap" in files
            assert row["recorded"] in row["detail"]
