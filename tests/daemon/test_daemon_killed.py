"""kill -9 of the daemon at random moments of a job: nothing is lost, the arm rests, the job tells the truth."""

from __future__ import annotations

import json
import random
import signal
import threading
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from daemon.conftest import checked_before, patient_text, quick_text, serving
from daemon.served import daemon_process
from daemon.test_full_disk import held_text, wait_for

from ident_service.cli import main
from ident_service.client import IdentClient
from ident_service.daemon.jobs.child_process import alive
from ident_service.errors import ArmError, MotionRefused
from ident_service.motion.command_channel import controlling_pid, is_control_file_in_use
from ident_service.operations.moving_arms import is_held
from ident_service.recordings.open import open_recording
from ident_service.registry.database import Database
from ident_service.registry.jobs import known_job
from ident_service.registry.state_folder import control_path
from ident_service.results.manifest import verified_files

ARM = "quick"
KINDS = ("run", "run", "check", "simulate")


def begin(client: IdentClient, kind: str) -> str:
    """A job, confirmed where it moves."""
    body: dict[str, object] = {"job": {"kind": kind, "arm": ARM}}
    if kind != "simulate":
        word = client.post(f"/api/v1/arms/{ARM}/challenge")["challenge"]
        body["confirm"] = {"name": ARM, "challenge": word}
    return str(client.post("/api/v1/jobs", body)["id"])


def carried(client: IdentClient, job: str, seconds: float) -> bool:
    """Renew a job's lease for some time; whether it lives still."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if client.get(f"/api/v1/jobs/{job}")["state"] not in ("queued", "running"):
            return False
        _renewed(client, job)
        time.sleep(0.2)
    return True


def checked(client: IdentClient) -> None:
    """The arm has a ticket."""
    job = begin(client, "check")
    ended = not carried(client, job, 240.0)
    seen = client.get(f"/api/v1/jobs/{job}")
    assert ended, seen
    assert seen["state"] == "done", seen


def excited(client: IdentClient, job: str) -> None:
    """Renew a run's lease until its motion has begun."""
    while "exciting" not in str(client.get(f"/api/v1/jobs/{job}")["progress"]):
        assert carried(client, job, 0.2)


def _renewed(client: IdentClient, job: str) -> None:
    try:
        client.post(f"/api/v1/jobs/{job}/lease")
    except MotionRefused as error:
        if "no lease to renew" not in str(error):
            raise


def settled(client: IdentClient, job: str) -> dict[str, Any]:
    """Wait until a restarted daemon knows what became of a job, and return the job."""
    until = time.monotonic() + 90.0
    while True:
        seen = client.get(f"/api/v1/jobs/{job}").json()
        if "being looked for" not in seen["detail"] and seen["state"] not in ("queued", "running"):
            return dict(seen)
        assert time.monotonic() < until, seen
        time.sleep(0.1)


def kill_once(state: Path, seed: int) -> str:
    """One kill; what became of the job."""
    chance = random.Random(seed)  # noqa: S311 - a seeded choice
    kind, text = chance.choice(KINDS), quick_text(ARM, 16)  # a motion of some seconds of this machine's time
    if kind == "run":
        checked_before(state, text)
    with daemon_process(state) as (process, client):
        client.post("/api/v1/arms", {"description": text})
        job, waiting = begin(client, kind), begin(client, "home")
        alive = carried(client, job, chance.uniform(0.0, 9.0))
        process.kill()
        process.wait()
    with Database(state) as db:
        assert db.is_intact()
        before = {row["id"]: row["state"] for row in db.rows("SELECT id, state FROM jobs")}
    assert not alive or before[job] in ("running", "done")
    with serving(state) as again:
        # What waited to move an arm is not begun by a restart.
        now = again.get(f"/api/v1/jobs/{waiting}").json()["state"]
        assert now == ("interrupted" if before[waiting] in ("queued", "running") else before[waiting])
        seen = settled(again, job)
        settled(again, waiting)  # which may have begun to move the arm when the job before it was done
        if before[job] == "running":
            assert seen["state"] == "interrupted"
        elif before[job] == "queued":
            assert seen["state"] in ("interrupted", "done")
        else:
            assert seen["state"] == before[job]
        # At rest: nobody has the arm, and a motion that ended by itself left no mark. A command that was begun in the
        # instant of the kill takes the arm, finds no lease, and lets go.
        until = time.monotonic() + 30.0
        while is_control_file_in_use(control_path(state, ARM)):
            assert time.monotonic() < until, "somebody has the arm"
            time.sleep(0.1)
        assert not (state / "arms" / ARM / "moving.json").exists()
        assert again.get(f"/api/v1/arms/{ARM}").json()["faults"] == []
        if kind == "run" and seen["run"] is not None and (folder := state / "runs" / seen["run"]).is_dir():
            ended = json.loads((folder / "ended.json").read_text())
            assert ended["state"] in ("stopped", "done")
            assert f"the motion ended: {ended['state']}" in seen["detail"] or seen["state"] != "interrupted"
            verified_files(folder)
            assert sum(len(block.stamp_ns) for block in open_recording(folder / "run.mcap").blocks()) > 0
            assert again.get(f"/api/v1/runs/{seen['run']}").json()["ending"] == ended["state"]
        lines = again.get("/api/v1/audit?most=500").json()
        assert [line["about"] for line in lines if line["what"] == "job created"].count(job) == 1
    with Database(state) as db:
        assert db.is_intact()
        assert not db.rows("SELECT id FROM jobs WHERE state IN ('queued', 'running')")
    return f"{kind}: {seen['state']}: {seen['detail']}"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 5, pytest.param(8, marks=pytest.mark.campaign)])
def test_a_daemon_that_is_killed(state: Path, seed: int) -> None:
    assert kill_once(state, seed)


@pytest.mark.campaign
@pytest.mark.timeout(7200)
def test_thirty_kills(state: Path) -> None:
    told = [kill_once(state.with_name(f"state{seed}"), seed) for seed in range(100, 130)]
    assert sum(line.startswith("run: interrupted") for line in told) >= 5, told


@pytest.mark.slow
def test_an_arm_that_is_held_when_the_daemon_is_killed_is_reported_and_let_down_by_the_next(
    state: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing of the next daemon waits for the process that holds the arm, but what needs the arm, and that says so."""
    checked_before(state, held_text())
    with daemon_process(state) as (process, client):
        client.add_arm(held_text())
        with (  # noqa: PT012 - it is raised in the block of the motion
            pytest.raises(ArmError, match=r"quick stops by itself: .*`ident recover quick` at the daemon's") as caught,
            client.arm("quick").run(confirm="quick") as motion,
        ):
            next(motion.live())
            process.kill()
            process.wait()
            client.job(motion.id)
        assert f"`ident jobs show {motion.id}` tells how the motion ended" in str(caught.value)
        begun = motion.id
    wait_for(lambda: is_held(state, ARM))
    # At the terminal the name is known without a daemon.
    assert main(["recover", ARM, "--state", str(state)]) == 3
    assert "Support the arm, then `ident supported quick`: process " in capsys.readouterr().out
    with daemon_process(state) as (process, client):
        seen = client.job(begun)
        assert (seen.state, seen.held) == ("interrupted", True)
        holder = controlling_pid(control_path(state, ARM))
        wait_for(lambda: f"process {holder} holds the arm quick until" in client.job(begun).detail)
        # A second kill changes nothing, and the command says of the arm what the client does.
        capsys.readouterr()
        threading.Timer(2.0, process.kill).start()
        assert main(["preflight", ARM, "--confirm", ARM, "--server", client.url, "--state", str(state)]) == 1
        told = capsys.readouterr()
        assert f"queued, waits for {begun}, which holds the arm quick" in told.out
        assert "quick stops by itself: " in told.err
        process.wait()
    with daemon_process(state) as (process, client):
        assert controlling_pid(control_path(state, ARM)) == holder
        started = time.monotonic()
        assert client.compute("base", arm="planar2").state == "done"
        asked = client.begin("recover", arm=ARM)
        words = wait_for(lambda: client.job(asked.id).detail)
        assert words.startswith(f"waits for {begun}, which holds the arm quick until a person confirms")
        assert time.monotonic() - started < 30.0  # and not the 40 s for which processes were looked for
        assert client.arm(ARM).stop()["arms"] == [ARM]
        assert is_held(state, ARM)
        words = ["--server", client.url, "--state", str(state)]
        assert main(["supported", ARM, "--confirm", ARM, *words]) == 0
        told = wait_for(lambda: "the motion ended: stopped" in client.job(begun).detail and client.job(begun))
        assert (told.state, told.held) == ("interrupted", False)
        assert client.wait(asked.id).state == "done"
        assert not is_control_file_in_use(control_path(state, ARM))
        # Nothing holds it any more, and both commands say the same of it.
        capsys.readouterr()
        assert main(["supported", ARM, "--confirm", ARM, *words]) == 2
        assert "no process of the daemon's machine holds it after a stop" in capsys.readouterr().err
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0
    assert main(["supported", ARM, "--confirm", ARM, "--state", str(state)]) == 2
    assert "not held: no process has the arm" in capsys.readouterr().err


@pytest.mark.slow
def test_a_computation_ends_with_its_daemon(state: Path) -> None:
    with daemon_process(state) as (process, client):
        job = client.begin("simulate", arm="planar2").id
        until = time.monotonic() + 60.0
        with closing(Database(state)) as db:
            while not (name := known_job(db, job)["process"]):
                assert time.monotonic() < until
                time.sleep(0.02)
        wait_for((state / "jobs" / job / "log").read_text)
        process.kill()
        process.wait()
        time.sleep(1.0)
        assert not alive(name)


@pytest.mark.slow
def test_a_terminated_daemon_stops_its_arm_first(state: Path) -> None:
    checked_before(state, patient_text(ARM))
    with daemon_process(state) as (process, client):
        client.post("/api/v1/arms", {"description": patient_text(ARM)})
        job = begin(client, "run")
        excited(client, job)
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
    assert not is_control_file_in_use(control_path(state, ARM))
    assert not (state / "serve.url").exists()
    with Database(state) as db:
        (row,) = db.rows("SELECT state, run FROM jobs WHERE id = ?", job)
    assert row["state"] == "cancelled"
    assert json.loads((state / "runs" / row["run"] / "ended.json").read_text())["state"] == "stopped"
