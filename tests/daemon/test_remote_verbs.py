"""`--server`: every verb of the command is done by a daemon, or says why not; what a daemon is not told is refused."""

from __future__ import annotations

import argparse
import json
import os
import pty
import re
import shlex
import shutil
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import pytest
from cli.hands import Hands
from daemon.conftest import checked_before, patient_text, quick_text
from daemon.served import daemon_thread
from daemon.verbs_bench import ON_A_BUS, on_a_bus, singular_copy, unstable_text

from ident_service.cli import main, parser
from ident_service.cli.arguments import LOCAL_ONLY, Parser
from ident_service.cli.remote import follow, remote_verbs
from ident_service.cli.remote_watching import named_files
from ident_service.client import IdentClient
from ident_service.errors import ArmError, ConfigError, MotionRefused, Problem, UnknownId, UsageError
from ident_service.registry.state_folder import arm_fault_store

RUN = "20260101T000000Z-quick"
SINGULAR = "20260103T000000Z-quick"


def verbs() -> dict[str, Parser]:
    """Every verb of the command, by its words."""

    def below(one: argparse.ArgumentParser) -> Iterator[tuple[str, Parser]]:
        for action in one._actions:
            if isinstance(action, argparse._SubParsersAction):
                for sub in action.choices.values():
                    if (word := sub.get_default("word")) is not None:
                        yield word, sub
                    yield from below(sub)

    return dict(below(parser()))


@pytest.mark.slow
def test_every_verb_is_done_by_a_daemon_or_says_why_not() -> None:
    done = remote_verbs()
    assert len(verbs()) > 45
    assert set(done) | set(LOCAL_ONLY) == set(verbs())
    assert not set(done) & set(LOCAL_ONLY)
    assert set(LOCAL_ONLY) == {
        *("serve", "backup", "doctor", "driver test", "emulate", "import", "new", "restore", "tokens add", "view"),
        *("completion", "schema"),
        *("bus import", "bus store", "bus restore", "bus report", "fleet status"),
    }
    assert all(len(why) > 10 for why in LOCAL_ONLY.values())
    for word, (_, told) in done.items():
        known = {action.dest for action in verbs()[word]._actions}
        assert told <= known, (word, told - known)
        # Where it writes to here, and who says so here, is nothing that a daemon can be told in silence.
        assert not told & {"by", "can_log", "lease_from_stdin", "keep"} or word == "prune", word


def test_verbs_of_this_machine_say_why(state: Path, capsys: pytest.CaptureFixture[str]) -> None:
    server = ["--server", "http://127.0.0.1:1", "--state", str(state)]
    for words in (
        ["serve"],
        ["import", "x"],
        ["tokens", "add", "ann", "--role", "viewer"],
        ["emulate", "x"],
        ["doctor"],
    ):
        with pytest.raises(SystemExit) as refused:
            main([*words, *server])
        assert refused.value.code == 2
        said = capsys.readouterr().err
        assert next(why for word, why in LOCAL_ONLY.items() if " ".join(words).startswith(word)) in said


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ["export", "r", "--by", "me"],
        ["accept", "r", "--note", "n", "--by", "me"],
        ["prune", "--keep", "1", "--by", "me"],
        ["compare", "a", "b", "--out", "x"],
        ["compare", "a", "b", "--keep"],
        ["preview", "planar2", "--out", "x"],
        ["preview", "planar2", "--model", "x"],
        ["watch", "planar2", "--by", "me"],
        ["rehearse", "planar2", "--out", "x"],
        ["rehearse", "planar2", "--can-log"],
        ["rehearse", "planar2", "--lease-from-stdin"],
        ["recover", "planar2", "--leave-limit", "--can-log"],
        ["home", "planar2", "--zero", "--can-log"],
    ],
)
def test_what_would_be_lost_is_refused(words: list[str], state: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # Nobody listens there: it is refused before anybody is asked.
    try:
        code = main([*words, "--server", "http://127.0.0.1:1", "--state", str(state)])
    except SystemExit as wrong:  # the verb itself does not know it
        code = int(wrong.code or 0)
    assert code == 2
    assert "cannot be reached" not in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("path", ["/etc/passwd", "../runs/x", "runs/x", ".hidden", "a b", ""])
def test_no_run_is_a_path(path: str, state: Path, capsys: pytest.CaptureFixture[str]) -> None:
    server = ["--server", "http://127.0.0.1:1", "--state", str(state)]
    more = {"accept": ["--note", "n"], "figures": ["--out", "x"]}
    for verb in ("report", "export", "verify", "feasible", "accept", "figures"):
        assert main([verb, path or ".", *more.get(verb, []), *server]) == 2
        assert "named by id" in capsys.readouterr().err


def test_a_stop_tells_arms_and_jobs_apart() -> None:
    class Answering(IdentClient):
        def __init__(self, arms: list[str], jobs: list[str]) -> None:
            self.answer = {"arms": arms, "jobs": jobs}

        def post(self, *_: object, **__: object) -> Any:
            return self.answer

    def said(arms: list[str], jobs: list[str]) -> str:
        return remote_verbs()["stop"][0](Answering(arms, jobs), parser().parse_args(["stop", "--server", "x"]))[1]

    assert said(["a", "b"], ["j1"]) == "stop requested of a, b; cancelled: job j1\n"
    assert said([], ["j1", "j2"]) == "cancelled: job j1, job j2\n"
    assert said([], []) == "no arm is moving; motions requested before now will not begin\n"


def test_a_stop_of_a_name_that_is_no_arm_is_an_error() -> None:
    class Refusing(IdentClient):
        url = "http://x"

        def __init__(self) -> None:
            pass

        def post(self, *_: object, **__: object) -> Any:
            raise UnknownId("no arm 'planr2' is known")

    with pytest.raises(UsageError, match="planr2: the daemon has no arm of this name, so nothing was stopped"):
        remote_verbs()["stop"][0](Refusing(), parser().parse_args(["stop", "planr2", "--server", "x"]))


def test_mistakes_in_a_description_that_was_sent_have_its_own_name(tmp_path: Path) -> None:
    mistakes = [Problem(Path("arm.yaml"), 8, 1, "gravity: wrong"), Problem(Path("base.yaml"), 1, 2, "name: wrong")]

    class Judging(IdentClient):
        def __init__(self) -> None:
            pass

        def post(self, *_: object, **__: object) -> Any:
            if mistakes:
                raise ConfigError(mistakes)
            return {"good": False, "text": "arm.yaml: bench: CANNOT MOVE\n  arm.yaml:3:1: joints: wrong\n"}

    mine = tmp_path / "mine.yaml"
    mine.write_text("name: bench\n")
    words = parser().parse_args(["config", "check", str(mine), "--server", "x"])
    with pytest.raises(ConfigError) as told:
        remote_verbs()["config check"][0](Judging(), words)
    assert str(told.value) == f"{mine}:8:1: gravity: wrong\nbase.yaml:1:2: name: wrong"
    mistakes.clear()
    code, text, _ = remote_verbs()["config check"][0](Judging(), words)
    assert (code, text) == (3, f"{mine}: bench: CANNOT MOVE\n  {mine}:3:1: joints: wrong\n")


def test_files_that_a_list_names_are_sent_too(tmp_path: Path) -> None:
    (tmp_path / "drive.eds").write_text("[FileInfo]")
    (tmp_path / "arm.yaml").write_text("driver: {drives: [{node: 1, eds: drive.eds}], profiles: [none.yaml]}\n")
    assert named_files(tmp_path / "arm.yaml") == {"drive.eds": "[FileInfo]"}


class _Evil(IdentClient):
    """A daemon that names files which lead elsewhere."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def get(self, path: str) -> Any:
        return {"files": {"../outside": 1}, "answer": {}}

    def content(self, path: str) -> bytes:
        raise AssertionError(path)


def test_a_daemon_does_not_choose_where_files_go_here(tmp_path: Path) -> None:
    from ident_service.cli.remote_results import _fetched

    words = argparse.Namespace(out=tmp_path / "out", json=True)
    with pytest.raises(ArmError, match="no plain name"):
        _fetched(_Evil(), words, (0, "", {"job": {"run": "e"}, "answer": {}}))
    assert list(tmp_path.iterdir()) == []


@contextmanager
def served(state: Path, commissioned: Path) -> Iterator[tuple[IdentClient, list[str]]]:
    """A daemon with two arms and three runs; the words that lead to it."""
    for run in (RUN, RUN.replace("0101", "0102")):
        shutil.copytree(commissioned, state / "runs" / run)
    singular_copy(commissioned, state / "runs" / SINGULAR)
    with daemon_thread(state) as client:
        for body in ({"description": quick_text()}, on_a_bus()):
            client.post("/api/v1/arms", body)
        until = time.monotonic() + 30.0
        while len(client.get("/api/v1/runs")) < 3:
            assert time.monotonic() < until
            time.sleep(0.05)
        yield client, ["--server", client.url, "--state", str(state)]


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_verbs_are_done_by_a_daemon(
    state: Path, commissioned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = RUN.replace("0101", "0102")
    with served(state, commissioned) as (client, server):

        def done(*words: object, code: int = 0) -> dict[str, Any]:
            capsys.readouterr()
            found = main([*map(str, words), *server, "--json"])
            out = capsys.readouterr()
            assert found == code, (words, out.out, out.err)
            return dict(json.loads(out.out))

        assert done("base", "quick")["answer"]["base_parameters"]["expressions"]
        assert done("preview", "quick")["job"]["state"] == "done"
        assert done("watch", "quick", "--seconds", 0.2)["answer"]
        assert done("recover", "quick")["answer"]["usable"] is True
        assert done("bus", "load", ON_A_BUS)["answer"]["fits"] is True
        assert done("bus", "scan", ON_A_BUS)["answer"]["complete"] is True
        assert done("bus", "probe", ON_A_BUS)["answer"]["good"] is True
        assert done("home", ON_A_BUS, "--zero", "--confirm", ON_A_BUS)["job"]["kind"] == "zero"
        done("home", ON_A_BUS, "--zero", "--confirm", "quick", code=2)
        assert done("config", "check", "quick")["answer"]["stability"]["stable"] is True
        (tmp_path / "arm.yaml").write_text(unstable_text())
        assert done("config", "check", tmp_path / "arm.yaml", code=3)["stable"] is False

        assert done("verify", RUN)["answer"]["message"].startswith("consistent with its own conditions: feasible: ")
        assert done("verify", RUN, "--arm", "quick")["answer"]["message"].startswith("proven for ")
        assert done("feasible", RUN, "--arm", "quick")["answer"]["feasible"] is True
        singular = done("correct", SINGULAR, "--metric", "covariance", "--out", tmp_path / "none.json", code=2)
        assert "singular" in singular["job"]["detail"]  # the metric was told
        assert not (tmp_path / "none.json").exists()
        done("correct", RUN, "--feasible-set", "inertia", "--out", tmp_path / "near.json")
        corrected = json.loads((tmp_path / "near.json").read_text())
        assert (corrected["method"], corrected["feasible_set"]) == ("correction", "inertia")
        assert done("compare", RUN, other)["answer"]["verdict"] == "unchanged"
        done("compare", RUN, other, RUN, code=2)
        assert done("payload", RUN, f"{RUN}/validation.mcap", "--out", tmp_path / "load", code=3)["export"]
        assert (tmp_path / "load" / "payload.json").is_file()
        done("report", RUN, "--out", tmp_path / "page.html")
        assert (tmp_path / "page.html").read_text().lstrip().lower().startswith("<!doctype html")
        files = done("export", RUN, "--format", "urdf,csv", "--out", tmp_path / "urdf")["answer"]["files"]
        assert {one["file"] for one in files} == {path.name for path in (tmp_path / "urdf").iterdir()}
        done("figures", RUN, "--out", tmp_path / "drawn")
        assert all(path.read_bytes().startswith(b"<svg") for path in (tmp_path / "drawn").iterdir())
        assert len(list((tmp_path / "drawn").iterdir())) > 5

        assert "nothing has been accepted" in done("compare", "accepted:quick", RUN, code=2)["error"]["message"]
        assert done("accept", RUN, "--note", "good")["number"] == 1
        assert done("compare", "accepted:quick", other)["job"]["request"]["run"] == RUN
        kept = done("delete", "run", RUN, code=2)["error"]["message"]
        assert kept.endswith(f"acceptance 1; to delete it all the same: `ident runs delete {RUN} --anyway`")
        assert done("accept", other, "--note", "better")["who"] == "owner"
        assert done("rollback", "quick", "--note", "back")["origin"] == 1
        assert done("prune", "--keep", 1)["deleted"] is False
        assert [row["name"] for row in done("token", "list")["tokens"]] == ["owner"]
        done("token", "revoke", "none", code=2)

        # Ctrl-C in the moment in which a job ends: there is nothing left to cancel, and that is no error.
        ended = client.get("/api/v1/jobs?most=1")[0]
        words = argparse.Namespace(json=True)
        assert follow(client, words, ended | {"state": "running"}, lambda: True, moves=False)["state"] == "done"


def test_a_command_renews_no_lease_of_a_motion_that_is_ending() -> None:
    asked = list[str]()
    running = {"id": "j", "state": "running", "detail": "", "held": False, "progress": None}

    class Daemon:
        """One whose motion was stopped by somebody else, and is at rest after three looks."""

        def post(self, path: str) -> None:
            asked.append(path)
            raise MotionRefused("the job j has no lease to renew: it is ending (ann has stopped it), which needs none")

        def get(self, path: str) -> dict[str, Any]:
            asked.append(path)
            return running | {"state": "cancelled" if asked.count(path) == 3 else "running"}

    words = argparse.Namespace(json=True)
    ended = follow(cast(IdentClient, Daemon()), words, running, lambda: False, moves=True, poll_seconds=0.02)
    assert ended["state"] == "cancelled"
    assert asked == ["/api/v1/jobs/j/lease", *["/api/v1/jobs/j"] * 3]


@pytest.mark.parametrize(
    ("said", "why"),
    [(b"stop\n", "a stop was requested"), (b"", "the program that started the motion has ended"), (None, "")],
)
def test_a_zeroing_that_nobody_asks_for_any_more_is_not_done(
    said: bytes | None,
    why: str,
    state: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    body = on_a_bus()
    (tmp_path / "arm.yaml").write_text(body["description"])
    (tmp_path / "emulated_drive.eds").write_text(body["files"]["emulated_drive.eds"])
    words = ["home", str(tmp_path / "arm.yaml"), "--zero", "--confirm", ON_A_BUS, "--lease-from-stdin"]
    reading, writing = os.pipe()
    os.write(writing, b"\n" if said is None else said)
    with os.fdopen(reading) as stdin, os.fdopen(writing, "wb") as held:
        monkeypatch.setattr("sys.stdin", stdin)
        if said == b"":
            held.close()
        assert main([*words, "--state", str(state)]) == (0 if said is None else 3)
    heard = capsys.readouterr()
    assert why in heard.err
    assert ("home is set, until its drives lose power" in heard.out) == (said is None)


@pytest.mark.campaign
@pytest.mark.slow
def test_a_rehearsal_elsewhere_ends_with_the_key_here(
    state: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("ident_service.cli.motion_commands.RELEASED", 2.0)  # a busy machine is no hand that lets go
    master, slave = pty.openpty()
    texts = {"patient": patient_text("patient"), "short": quick_text("short", 1)}
    for text in texts.values():
        checked_before(state, text)
    # The lease of a rehearsal is a quarter of a second, and on a busy machine the next renewal comes later.
    with daemon_thread(state) as client:
        server = ["--server", client.url, "--state", str(state)]
        for text in texts.values():
            client.post("/api/v1/arms", {"description": text})
        rehearse = ["run", "--hold-to-run", "patient", "--confirm", "patient", *server]
        assert main([*rehearse, "--json"]) == 2  # a program holds no key
        assert "no terminal" in capsys.readouterr().err
        before = termios.tcgetattr(slave)
        with os.fdopen(os.dup(slave)) as stdin, Hands(master) as hands:
            monkeypatch.setattr("sys.stdin", stdin)

            def told(_: object, line: str) -> None:
                if line in ("approaching", "exciting"):
                    hands.let_go()

            monkeypatch.setattr("ident_service.cli.remote.tell", told)
            assert main(rehearse) == 1
        job = client.get("/api/v1/jobs?most=1")[0]
        assert (job["kind"], job["state"], job["detail"]) == ("rehearse", "cancelled", "cancelled by owner")
        assert client.get(f"/api/v1/runs/{job['run']}")["ending"] == "stopped"
        assert client.get("/api/v1/arms/patient")["faults"] == []
        assert termios.tcgetattr(slave) == before
        # Without a key it goes to its end, its lease renewed by the command.
        assert main(["rehearse", "short", "--confirm", "short", "--no-key", *server]) == 0
        assert client.get("/api/v1/jobs?most=1")[0]["state"] == "done"
    os.close(master)
    os.close(slave)


@pytest.mark.slow
def test_a_person_elsewhere_reads_what_one_at_the_machine_does(
    state: Path, commissioned: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with daemon_thread(state) as client:
        server = ["--server", client.url, "--state", str(state)]
        client.add_arm(quick_text())
        client.add_arm(unstable_text().replace("name: quick", "name: unstable"))
        assert main(["check", "unstable", "--confirm", "unstable", *server]) == 3
        said = capsys.readouterr().out
        assert "FAILED     gains are stable at this rate and delay" in said  # the table
        assert "-> Lower kp and kd" in said
        job = next(client.jobs())
        assert job.detail.startswith("stability: ")
        assert main(["jobs", "show", job.id, *server]) == 0
        assert "FAILED     gains are stable" in capsys.readouterr().out
        assert main(["config", "check", "quick", *server]) == 0
        assert "\nnext: ident preflight quick --state " in capsys.readouterr().out
        # The commands that are named can be given as they stand.
        arm_fault_store(state, "quick").latch("late_cycle", "a cycle came late")
        assert main(["preflight", "quick", "--confirm", "quick", *server]) != 0
        assert "\nnext: ident recover quick --state " in capsys.readouterr().out
        assert main(["recover", "quick", *server]) == 3
        said = capsys.readouterr().out
        told, _, following = said.partition("\nnext: ")
        assert str(state) not in told
        assert following.endswith(f"--state {state} {shlex.join(server[:2])}\n")  # as this person has given it
        commands = [shlex.split(one)[1:] for one in re.findall(r"`(ident [^`]+)`", said)]
        assert ["acknowledge", "quick", "late_cycle", *server[:2]] in commands
        for words in commands:
            assert parser().parse_args(words).arm == "quick"
        assert main([*next(one for one in commands if one[0] == "acknowledge"), "--state", str(state)]) == 0
        assert main(["recover", "quick", *server]) == 0
        assert client.answer(next(client.jobs()).id)["steps"] == ["`ident preflight quick` for the next motion."]


@pytest.mark.parametrize("typed", ["", "yes"])
def test_a_preflight_elsewhere_asks_what_one_at_the_machine_does(
    typed: str, state: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = list[str]()

    def answer(question: str) -> str:
        asked.append(question)
        return typed

    monkeypatch.setenv("IDENT_TOKEN", "none")
    monkeypatch.setattr("builtins.input", answer)
    monkeypatch.setattr("ident_service.cli.progress.person_types", lambda: True)
    here, there = ["--state", str(state)], ["--state", str(state), "--server", "http://127.0.0.1:9"]
    assert main(["preflight", "planar2", *here]) == 3
    told = capsys.readouterr().out
    assert main(["preflight", "planar2", *there]) == 3  # and nothing is sent
    assert asked[1] == f"It is where you may not see it: type only what you see. {asked[0]}"
    refused = capsys.readouterr().err
    why, remedy = re.findall(r"(?m)(?:\w.* NEEDS YOU: |^-> )(.*)$", refused)
    assert why in told
    assert remedy in told
    assert refused.endswith(f"\nnext: ident preflight planar2 {shlex.join(there)}\n")
    monkeypatch.setattr("ident_service.cli.progress.person_types", lambda: False)
    assert main(["preflight", "planar2", *there]) == 3
    motion = state / "motion.json"
    motion.write_text("{}")
    assert main(["preflight", "planar2", str(motion), *there]) == 3  # nor is the motion sent
    assert main(["preflight", "planar2", "--confirm", "other", *there]) == 2  # as at the machine
    assert len(asked) == 2


@pytest.mark.slow
def test_a_fault_elsewhere_is_told_with_what_it_left(state: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = quick_text("faulty", 16).replace("driver:\n", "driver:\n  faults: [{kind: nan_position, at: 25}]\n", 1)
    checked_before(state, text)
    with daemon_thread(state) as client:
        client.add_arm(text)
        assert main(["run", "faulty", "--confirm", "faulty", "--server", client.url, "--state", str(state)]) == 4
        told, job = capsys.readouterr().out.partition("\nnext: ")[0], next(client.jobs())
        left = client.answer(job.id)["files"]
    ended = f"job {job.id}: run, faulted\n{job.detail}\nrun {job.run}\n"
    files = "".join(f"\n  {name}" for name in left)
    assert told.endswith(f"{ended}recording until the fault: runs/{job.run}/run.mcap\nfiles: runs/{job.run}{files}")


@pytest.mark.slow
def test_what_is_no_file_here_is_reported_and_files_of_a_description_are_sent(
    state: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with daemon_thread(state) as client:
        server = ["--server", client.url, "--state", str(state)]
        for words in (
            ["identify", "monday.csv", "--arm", "planar2"],
            ["identify", "runs/monday.csv", "--arm", "planar2"],
            ["preview", "planar2", "monday.json"],
            ["run", "planar2", str(tmp_path / "monday.json"), "--confirm", "planar2"],
        ):
            assert main([*words, *server]) == 2
            assert re.search(r"monday.\w+: no such file here, and the daemon at http", capsys.readouterr().err)
        body = on_a_bus()
        (tmp_path / "arm.yaml").write_text(body["description"])
        (tmp_path / "emulated_drive.eds").write_text(body["files"]["emulated_drive.eds"])
        assert main(["config", "check", str(tmp_path / "arm.yaml"), *server]) == 0
        broken = "format: ident-arm\nversion: 1\nname: broken\nkinematics: {urdf: broken.urdf}\n"
        (tmp_path / "arm.yaml").write_text(broken)
        (tmp_path / "broken.urdf").write_text("<robot name='a'><link name='b'/>")
        capsys.readouterr()
        assert main(["config", "check", str(tmp_path / "arm.yaml"), *server]) == 2
        assert "arm.yaml:4:1: kinematics: broken.urdf: not a URDF" in capsys.readouterr().err
