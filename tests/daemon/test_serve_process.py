"""The daemon as a process: one per state folder, ready and alive for its manager, and the command that asks it."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from daemon.conftest import quick_text
from daemon.served import daemon_process

from ident_service.cli import main
from ident_service.client import IdentClient
from ident_service.daemon.jobs.child_process import ANSWER, LOG, PROCESS, UnitChild, alive, name_of
from ident_service.daemon.jobs.commands import command_of_request
from ident_service.daemon.jobs.requests import Watch
from ident_service.daemon.jobs.socket_activation import is_allowed
from ident_service.daemon.serve import notify_systemd, watchdog_seconds
from ident_service.errors import ArmError, MotionRefused, UnknownId, UsageError
from ident_service.motion.command_channel import ControlFile
from ident_service.operations.run_archive import import_run
from ident_service.registry.arms import register_shipped_arms
from ident_service.registry.database import Database
from ident_service.registry.state_folder import control_path

pytestmark = pytest.mark.slow


def ident(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, dict[str, Any]]:
    """Exit code and document of a command."""
    capsys.readouterr()
    try:
        code = main([*map(str, words), "--json"])
    except SystemExit as end:
        code = int(end.code or 0)
    document = json.loads(capsys.readouterr().out)
    assert document["exit_code"] == code
    return code, document


def test_the_command_drives_a_daemon(state: Path, commissioned: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with daemon_process(state) as (process, client):
        # One instance, and everything below the state folder is its own.
        second = subprocess.run(
            [sys.executable, "-m", "ident_service", "serve", "--port", "0", "--state", str(state)],
            capture_output=True,
            text=True,
            check=False,
        )
        assert second.returncode == 2
        assert f"process {process.pid} serves this state folder already" in second.stderr
        assert client.get("/healthz")["healthy"] is True
        for name in ("token", "registry.sqlite", "serve.lock"):
            assert stat.S_IMODE((state / name).stat().st_mode) == 0o600, name
        server = ("--server", client.url, "--state", state)
        client.post("/api/v1/arms", {"description": quick_text()})
        (state / "quick.yaml").write_text(quick_text())
        code, document = ident(capsys, "run", "quick", *server)
        assert (code, document["error"]["kind"]) == (2, "UsageError")
        assert "--confirm quick" in document["error"]["message"]
        code, document = ident(capsys, "check", "quick", "--confirm", "quick", *server)
        assert (code, document["job"]["state"]) == (0, "done")
        words = ("--until", "0.0001", "--parameter", "fv1", "--parameter", "fc1", "--confirm", "quick")
        code, document = ident(capsys, "run", "quick", *words, *server)
        assert (code, document["job"]["state"]) == (0, "done")
        wanted = {"share": 0.0001, "parameters": ["fv1", "fc1"]}
        assert document["job"]["request"]["until"] == wanted
        until = document["answer"]["report"]["until"]
        assert {one["parameter"] for one in until.pop("missed")} == {"fv1", "fc1"}
        assert until == {**wanted, "reached": None}
        assert ident(capsys, "run", "quick", "--parameter", "fv1", "--confirm", "quick", *server)[0] == 2
        with Database(state) as db:
            run = import_run(db, state, commissioned, "test")["id"]
        assert main(["identify", f"{run}/identification.mcap", "--arm", "quick", *map(str, server)]) == 0
        said = capsys.readouterr().out
        (made,) = {path.name for path in (state / "runs").iterdir()} & set(said.split())
        # As at the daemon's machine: the text of its report but for the table.
        summary, table = (state / "runs" / made / "report.txt").read_text().split("\nbase parameter ")
        assert summary.startswith(("Use", "USE"))
        assert f"{summary}\nfiles: runs/{made}\n  parameters.json\n" in said
        assert table.splitlines()[1] not in said
        code, document = ident(capsys, "simulate", "wam7", *server)
        assert (code, document["job"]["state"]) == (2, "failed")
        assert ident(capsys, "verify", "x.json", *server)[0] == 2
        assert ident(capsys, "jobs", "list", "--state", state)[1]["jobs"][0]["kind"] == "simulate"
        with ControlFile.take(control_path(state, "quick"), None) as mover:
            mover.request_pause(True)
            assert ident(capsys, "finish", "quick", *server)[1]["reached"] is True
            assert (mover.finish, mover.pause, mover.stop) == (True, False, False)
            mover.request_pause(True)
            # At a terminal of the same machine it is the same.
            assert ident(capsys, "finish", state / "quick.yaml", "--state", state)[0] == 0
            assert not mover.pause
            assert ident(capsys, "stop", "quick", *server)[1]["arms"] == ["quick"]
            assert mover.stop
        # Nobody moves it now, which is what was wanted; a name that was mistyped has stopped nothing.
        assert ident(capsys, "stop", "quick", *server)[0] == 0
        assert ident(capsys, "stop", "quik", *server)[0] == 2
        # The same acts at a terminal are in the same trail.
        assert ident(capsys, "accept", state / "runs" / run, "--note", "at the terminal", "--state", state)[0] == 0
        assert client.get("/api/v1/arms/quick")["accepted"]["who"].startswith("terminal:")
        code, document = ident(capsys, "token", "add", "ann", "--role", "viewer", "--state", state)
        looks = IdentClient(client.url, document["token"])
        assert looks.get("/api/v1/whoami") == {"name": "ann", "role": "viewer"}
        assert "ident_jobs" in _metrics(client)
        with pytest.raises(UsageError, match="only read"):
            looks.post("/api/v1/jobs", {"job": {"kind": "simulate", "arm": "quick"}})
        with pytest.raises(UnknownId):
            client.get("/api/v1/runs/none")
        with pytest.raises(MotionRefused):
            client.post("/api/v1/jobs", {"job": {"kind": "home", "arm": "quick"}})
        looks.close()
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
        with pytest.raises(ArmError, match="cannot be reached"):
            client.get("/healthz")
    for line in (state.parent / "serve.log").read_text().splitlines():
        if line.startswith("{"):
            assert {"time", "level", "logger", "message"} <= set(json.loads(line))
    assert "ident_" not in (state.parent / "serve.log").read_text().replace("ident_service", "")


def _metrics(client: IdentClient) -> str:
    return client.content("/metrics").decode()


def test_a_manager_hears_ready_alive_and_stopping(state: Path, tmp_path: Path) -> None:
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(path))
        manager.settimeout(60)
        with daemon_process(state, NOTIFY_SOCKET=str(path), WATCHDOG_USEC="400000") as (process, _):
            heard = {manager.recv(100).decode() for _ in range(3)}
            assert heard == {"READY=1", "WATCHDOG=1"}
            process.send_signal(signal.SIGTERM)
            while manager.recv(100) != b"STOPPING=1":
                pass
            assert process.wait(60) == 0


def test_without_a_manager_nothing_is_stated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    notify_systemd("READY=1")
    monkeypatch.setenv("NOTIFY_SOCKET", "/nowhere/at/all")
    notify_systemd("READY=1")
    monkeypatch.setenv("WATCHDOG_USEC", "3000000")
    monkeypatch.setenv("WATCHDOG_PID", "1")
    assert watchdog_seconds() is None
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
    assert watchdog_seconds() == 1.5


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--host", "0.0.0.0"), "can be reached from other machines"),  # noqa: S104 - refused
        (("--host", "192.0.2.1", "--port", "1"), "can be reached from other machines"),
        (("--tls-cert", "nowhere.pem"), "both"),
        (("--tls-cert", "nowhere.pem", "--tls-key", "nowhere.pem"), "no such file"),
    ],
)
def test_what_would_be_open_is_not_served(
    state: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], reason: str
) -> None:
    code, document = ident(capsys, "serve", *words, "--state", state)
    assert code == 2
    assert reason in document["error"]["message"]
    assert not (state / "token").exists()


def test_tls_that_cannot_be_spoken_is_stated_before_anything_begins(
    state: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def made(name: str, *more: str) -> tuple[Path, Path]:
        key, pem = tmp_path / f"{name}.key", tmp_path / f"{name}.pem"
        words = ("openssl", "req", "-x509", "-newkey", "ed25519", "-days", "2", "-subj", "/CN=localhost")
        subprocess.run(
            [*words, "-keyout", str(key), "-out", str(pem), *(more or ("-nodes",))], check=True, capture_output=True
        )
        return pem, key

    pem, key = made("good")
    _, other = made("other")
    _, locked = made("locked", "-passout", "pass:secret")
    words = tmp_path / "words.pem"
    words.write_text("no certificate\n")
    for cert, own, reason in (
        (words, key, "both PEM"),
        (pem, words, "both PEM"),
        (pem, other, "the key is not that of the certificate"),
        (pem, locked, "the key is encrypted"),
    ):
        code, document = ident(capsys, "serve", "--tls-cert", cert, "--tls-key", own, "--state", state)
        assert code == 2
        assert reason in document["error"]["message"]
    assert not state.exists()


@pytest.mark.parametrize(
    "url",
    ["http://robot.example:8470", "ftp://127.0.0.1", "127.0.0.1:8470", "http://u@localhost", "http://127.0.0.1:99999"],
)
def test_a_token_is_sent_nowhere_in_the_clear(url: str) -> None:
    with pytest.raises(UsageError):
        IdentClient(url, "ident_secret")


def motion_unit(folder: Path, request: dict[str, Any], more: bytes = b"") -> tuple[int, str]:
    """What a motion's own unit makes of a request: its exit code and what the journal hears."""
    ours, theirs = socket.socketpair()
    with ours, theirs:
        process = subprocess.Popen(
            [sys.executable, "-m", "ident_service.daemon.jobs.socket_activation"],
            stdin=theirs,
            stdout=theirs,
            stderr=subprocess.PIPE,
            text=True,
        )
        theirs.close()
        ours.sendall(json.dumps(request).encode() + b"\n" + more)
        ours.shutdown(socket.SHUT_WR)
        return process.wait(120), process.communicate()[1]


def test_a_unit_of_its_own_does_motions_under_a_lease_and_nothing_else(state: Path, tmp_path: Path) -> None:
    folder = tmp_path / "job"
    folder.mkdir()
    forbidden = [
        ["serve"],
        ["simulate", "planar2", "--json"],
        ["run", "planar2"],
        [],
        ["-c", "x"],
        ["bus", "load", "x"],
    ]
    # What looks may not move; argparse would take the beginning of an option for the whole.
    forbidden += [["bus", "load", "planar2"], ["token", "list"]]
    forbidden += [["recover", "planar2", option, "--json"] for option in ("--leave-limit", "--leave", "--l", "--out=x")]
    assert not any(map(is_allowed, forbidden))
    for words in forbidden:
        code, said = motion_unit(folder, {"folder": str(folder), "words": words})
        assert (code, "only motions" in said) == (2, True), words
    assert list(folder.iterdir()) == []
    words = ["home", "planar2", "--lease-from-stdin", "--json", "--state", str(state)]
    code, _ = motion_unit(folder, {"folder": str(folder), "words": words})
    assert code == 3  # it was not checked, in the words of the command
    assert json.loads((folder / ANSWER).read_text())["error"]["kind"] == "MotionRefused"
    assert "no preflight ticket" in (folder / LOG).read_text()
    assert not alive((folder / PROCESS).read_text().strip())
    # And it looks at the arm, whose bus is here.
    looks = folder / "looks"
    looks.mkdir()
    with Database(state) as db:
        register_shipped_arms(db)
        seen = command_of_request(db, state, Watch(kind="watch", arm="planar2", seconds=0.1)).words
    assert motion_unit(looks, {"folder": str(looks), "words": list(seen)})[0] == 0
    answer = json.loads((looks / ANSWER).read_text())
    assert (answer["exit_code"], " cycles, 0 frames lost\n" in answer["text"]) == (0, True)
    # Files that are there already are nobody's to overwrite.
    assert motion_unit(folder, {"folder": str(folder), "words": words})[0] == 2


def test_a_child_behind_a_socket_is_commanded_and_read(tmp_path: Path) -> None:
    path, folder = tmp_path / "door", tmp_path / "job"
    folder.mkdir()
    with pytest.raises(UsageError, match=r"ident-motion\.socket"):
        UnitChild(("home",), folder, path)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listening:
        listening.bind(str(path))
        listening.listen()
        child = UnitChild(("home", "a"), folder, path)
        unit, _ = listening.accept()
        with unit:
            assert json.loads(unit.recv(1000)) == {"folder": str(folder), "words": ["home", "a"]}
            child.say(b"\n")
            child.say(b"stop\n")
            assert unit.recv(10) == b"\nstop\n"
            assert (child.process, child.exit_code, child.ended()) == ("", None, False)
            child.close()
            assert select.select([unit], [], [], 10.0)[0]
            assert unit.recv(10) == b""
        assert child.ended()
        child.close()


def test_a_process_is_found_again_by_more_than_its_number() -> None:
    name = name_of(os.getpid())
    assert alive(name)
    pid, began, boot = name.split()
    assert not alive(f"{pid} {int(began) + 1} {boot}")
    assert not alive("")
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        other = name_of(process.pid)
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        assert not alive(other)  # a zombie has ended
